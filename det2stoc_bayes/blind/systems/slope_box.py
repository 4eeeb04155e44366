"""A box that slides down a windy slope, tumbles and may hit a post."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <geom name="slope" type="plane" size="20 20 0.1" zaxis="0 -0.42262 0.90631"
        contype="1" conaffinity="1" condim="6" friction="0.2 0.005 0.0001"/>
    <geom name="post" type="cylinder" size="0.25 0.3" pos="0 -1.2 -0.43" zaxis="0 -0.42262 0.90631"
        contype="1" conaffinity="1" condim="6" friction="0.2 0.005 0.0001"/>
    <body name="box" pos="0 -0.1057 0.2266" euler="25 0 0">
      <freejoint name="slide"/>
      <geom name="hull" type="box" size="0.25 0.25 0.25" mass="1.2"
        contype="1" conaffinity="1" condim="6" friction="0.2 0.005 0.0001"/>
      <site name="mark" pos="0 0 0.25"/>
    </body>
  </worldbody>
"""

SYSTEM = System(
    name="slope_box",
    title="box on a windy slope with a post",
    body_xml=XML,
    psi=(
        normal("friction", "geom/*/friction", 0.2, 0.04, 0),
        normal("wind_speed", "opt/wind", 4.0, 0.8, 0),
    ),
    noise_sd={"qpos/*/q*": 1e-3, "qpos/*": 5e-4, "qvel/*/w*": 2e-2, "qvel/*": 1e-2},
    start_position=(0.4, 0.0, 0.0, 0.0, 0.0, 0.0),
    start_velocity=(0.3, 0.4, 0.0, 0.0, 0.0, 0.5),
    reach=(15.0, 18.0, 18.0, 10.0, 10.0, 10.0),
    sampling=(0.01, 0.02),
    timestep=0.002,
    integrator="implicitfast",
    medium=' density="1.2" wind="4 0 0" cone="elliptic"',
    touching=True,
    samples=100,
)
