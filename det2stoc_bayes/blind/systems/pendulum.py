"""A driven pendulum."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="pivot" type="hinge" axis="0 1 0" damping="0.06"/>
      <geom name="rod_tube" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.025" mass="1.0"/>
      <site name="mark" pos="0 0 -0.5"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="drive" joint="pivot"/>
  </actuator>
"""

SYSTEM = System(
    name="pendulum",
    title="driven pendulum",
    body_xml=XML,
    psi=(
        normal("rod_mass", "body/rod/mass", 1.0, 0.15),
        normal("pivot_damping", "joint/pivot/damping", 0.06, 0.015),
        normal("drive_gain", "actuator/drive/gainprm", 1.0, 0.1, 0),
    ),
    noise_sd={"qpos/*": 2e-3, "qvel/*": 2e-2},
    start_position=(1.6,),
    start_velocity=(3.0,),
    reach=(2.5,),
    input_scale=(1.3,),
    sampling=(0.01, 0.015, 0.02),
)
