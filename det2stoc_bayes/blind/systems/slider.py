"""A carriage on a sprung rail."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <body name="carriage" pos="0 0 0.5">
      <joint name="rail" type="slide" axis="1 0 0" stiffness="60" damping="2.0"/>
      <geom name="carriage_box" type="box" size="0.08 0.05 0.04" mass="2.0"/>
      <site name="mark" pos="0 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="coil" joint="rail"/>
  </actuator>
"""

SYSTEM = System(
    name="slider",
    title="carriage on a sprung rail",
    body_xml=XML,
    psi=(
        normal("carriage_mass", "body/carriage/mass", 2.0, 0.3),
        normal("rail_stiffness", "joint/rail/stiffness", 60.0, 9.0),
        normal("rail_damping", "joint/rail/damping", 2.0, 0.4),
    ),
    noise_sd={"qpos/*": 1e-3, "qvel/*": 1e-2},
    start_position=(0.3,),
    start_velocity=(1.0,),
    reach=(1.0,),
    input_scale=(15.0,),
    sampling=(0.01, 0.015, 0.02),
)
