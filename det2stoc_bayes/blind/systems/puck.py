"""A puck that slides and turns on a table and may bump into a rail."""

from det2stoc_bayes.blind.systems.base import System, normal, positive

XML = """  <worldbody>
    <geom name="table" type="plane" size="3 3 0.1"
        contype="1" conaffinity="1" condim="4" friction="0.2 0.003 0.0001"/>
    <geom name="rail" type="box" size="0.02 1.5 0.05" pos="0.6 0 0.05"
        contype="1" conaffinity="1" condim="4" friction="0.2 0.003 0.0001"/>
    <body name="puck" pos="0 0 0.015">
      <freejoint name="glide"/>
      <geom name="disc" type="cylinder" size="0.05 0.015" mass="0.2"
        contype="1" conaffinity="1" condim="4" friction="0.2 0.003 0.0001"/>
      <site name="mark" pos="0.05 0 0"/>
    </body>
  </worldbody>
"""

SYSTEM = System(
    name="puck",
    title="puck on a table with a rail",
    body_xml=XML,
    psi=(normal("friction", "geom/*/friction", 0.2, 0.04, 0), positive("turning", "geom/*/friction", -5.8, 0.3, 1)),
    noise_sd={"qpos/*/q*": 1e-3, "qpos/*": 3e-4, "qvel/*/w*": 5e-2, "qvel/*": 5e-3},
    start_position=(0.1, 0.3, 0.0, 0.0, 0.0, 3.0),
    start_velocity=(1.0, 0.7, 0.0, 0.0, 0.0, 10.0),
    mean_velocity=(0.8, 0.0, 0.0, 0.0, 0.0, 0.0),
    reach=(3.0, 3.0, 0.1, 1.0, 1.0, 50.0),
    sampling=(0.01,),
    timestep=0.002,
    integrator="implicitfast",
    medium=' cone="elliptic"',
    touching=True,
    samples=100,
)
