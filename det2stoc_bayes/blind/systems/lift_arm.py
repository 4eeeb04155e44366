"""An arm that lifts: two links with geared torque motors and an unbalanced tool."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <body name="boom" pos="0 0 1">
      <joint name="lift" type="hinge" axis="0 -1 0" damping="1.2" stiffness="20" springref="0.5"/>
      <geom name="boom_tube" type="capsule" fromto="0 0 0 0.45 0 0" size="0.03" mass="2.0"/>
      <body name="jib" pos="0.45 0 0">
        <joint name="bend" type="hinge" axis="0 -1 0" damping="0.4"/>
        <geom name="jib_tube" type="capsule" fromto="0 0 0 0.3 0 0" size="0.025" mass="0.8"/>
        <geom name="tool" type="sphere" pos="0.3 0 -0.04" size="0.04" mass="0.4"/>
        <site name="mark" pos="0.3 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="lift_motor" joint="lift" gear="10"/>
    <motor name="bend_motor" joint="bend" gear="5"/>
  </actuator>
"""

SYSTEM = System(
    name="lift_arm",
    title="lifting arm",
    body_xml=XML,
    psi=(
        normal("boom_mass", "body/boom/mass", 2.0, 0.25),
        normal("jib_mass", "body/jib/mass", 1.2, 0.15),
        normal("lift_damping", "joint/lift/damping", 1.2, 0.25),
        normal("lift_gain", "actuator/lift_motor/gainprm", 1.0, 0.08, 0),
    ),
    noise_sd={"qpos/*": 1e-3, "qvel/*": 1e-2},
    start_position=(0.5, 0.8),
    start_velocity=(1.0, 1.0),
    reach=(2.6, 3.0),
    input_scale=(1.6, 0.7),
    sampling=(0.01, 0.02),
    known="joint/lift/stiffness",
)
