"""A light ball that spins through moving air."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <body name="ball" pos="0 0 5">
      <freejoint name="flight"/>
      <geom name="shell" type="sphere" size="0.15" mass="0.12"/>
      <site name="mark" pos="0.15 0 0"/>
    </body>
  </worldbody>
"""

SYSTEM = System(
    name="ball",
    title="ball in flight",
    body_xml=XML,
    psi=(normal("ball_mass", "body/ball/mass", 0.12, 0.015), normal("air_speed", "opt/wind", 2.0, 0.5, 0)),
    noise_sd={"qpos/*/q*": 3e-3, "qpos/*": 2e-3, "qvel/*/w*": 5e-2, "qvel/*": 2e-2},
    start_position=(0.5, 0.5, 0.5, 3.0, 3.0, 3.0),
    start_velocity=(6.0, 6.0, 4.0, 15.0, 15.0, 15.0),
    mean_velocity=(0.0, 0.0, 6.0, 0.0, 0.0, 0.0),
    reach=(60.0, 60.0, 60.0, 10.0, 10.0, 10.0),
    sampling=(0.005, 0.01),
    medium=' density="1.2" viscosity="1.8e-5" wind="2 0 0"',
)
