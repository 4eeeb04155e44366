"""A rotary pendulum: a driven arm about the vertical carries a hanging pendulum."""

from det2stoc_bayes.blind.systems.base import System, normal, positive

XML = """  <worldbody>
    <body name="rotor" pos="0 0 1">
      <joint name="yaw" type="hinge" axis="0 0 1" damping="0.02"/>
      <geom name="rotor_tube" type="capsule" fromto="0 0 0 0.25 0 0" size="0.015" mass="0.4"/>
      <body name="bob" pos="0.25 0 0">
        <joint name="pitch" type="hinge" axis="1 0 0" damping="0.003"/>
        <geom name="bob_tube" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.012" mass="0.2"/>
        <site name="mark" pos="0 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="yaw_motor" joint="yaw"/>
  </actuator>
"""

SYSTEM = System(
    name="furuta",
    title="rotary pendulum",
    body_xml=XML,
    psi=(
        normal("bob_mass", "body/bob/mass", 0.2, 0.03),
        positive("yaw_damping", "joint/yaw/damping", -3.9, 0.3),
        positive("pitch_damping", "joint/pitch/damping", -5.8, 0.3),
        normal("yaw_gain", "actuator/yaw_motor/gainprm", 1.0, 0.1, 0),
    ),
    noise_sd={"qpos/*": 2e-3, "qvel/*": 3e-2},
    start_position=(1.0, 1.0),
    start_velocity=(1.5, 2.0),
    reach=(20.0, 2.5),
    input_scale=(0.12,),
    sampling=(0.01, 0.015),
    known="body/rotor/mass",
)
