"""A planar arm with two links."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <body name="upper_arm" pos="0 0 1.2">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.5"/>
      <geom name="upper_tube" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1.5"/>
      <body name="forearm" pos="0 0 -0.4">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.25"/>
        <geom name="fore_tube" type="capsule" fromto="0 0 0 0 0 -0.35" size="0.025" mass="0.9"/>
        <site name="mark" pos="0 0 -0.35"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder"/>
    <motor name="elbow_motor" joint="elbow"/>
  </actuator>
"""

SYSTEM = System(
    name="arm",
    title="planar arm with two links",
    body_xml=XML,
    psi=(
        normal("forearm_mass", "body/forearm/mass", 0.9, 0.12),
        normal("elbow_damping", "joint/elbow/damping", 0.25, 0.05),
        normal("shoulder_gain", "actuator/shoulder_motor/gainprm", 1.0, 0.1, 0),
    ),
    noise_sd={"qpos/*": 2e-3, "qvel/*": 2e-2},
    start_position=(0.9, 0.9),
    start_velocity=(1.5, 1.5),
    reach=(2.0, 2.4),
    input_scale=(4.0, 1.5),
    sampling=(0.01, 0.015, 0.02),
    known="body/upper_arm/mass",
)
