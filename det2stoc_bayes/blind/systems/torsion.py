"""Two discs on a torsion rod, the lower one driven."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <body name="hub" pos="0 0 0.5">
      <joint name="shaft" type="hinge" axis="0 0 1" damping="0.05" stiffness="1.5"/>
      <geom name="hub_disc" type="cylinder" size="0.12 0.01" mass="1.5"/>
      <body name="disc" pos="0 0 0.3">
        <joint name="rod" type="hinge" axis="0 0 1" damping="0.006" stiffness="2.2"/>
        <geom name="top_disc" type="cylinder" size="0.12 0.01" mass="1.2"/>
        <site name="mark" pos="0.1 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="drive" joint="shaft"/>
  </actuator>
"""

SYSTEM = System(
    name="torsion",
    title="two discs on a torsion rod",
    body_xml=XML,
    psi=(
        normal("rod_stiffness", "joint/rod/stiffness", 2.2, 0.3),
        normal("rod_damping", "joint/rod/damping", 0.006, 0.0015),
        normal("shaft_damping", "joint/shaft/damping", 0.05, 0.012),
        normal("drive_gain", "actuator/drive/gainprm", 1.0, 0.1, 0),
    ),
    noise_sd={"qpos/*": 2e-3, "qvel/*": 3e-2},
    start_position=(1.2, 0.8),
    start_velocity=(2.0, 2.0),
    reach=(6.0, 5.0),
    input_scale=(1.2,),
    sampling=(0.01, 0.015),
)
