"""A small box that is thrown onto a board, bounces and tumbles."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <geom name="board" type="plane" size="3 3 0.1"
        contype="1" conaffinity="1" friction="0.3 0.005 0.0001" solref="0.02 0.6"/>
    <body name="box" pos="0 0 0.25">
      <freejoint name="toss"/>
      <geom name="shell" type="box" size="0.05 0.04 0.03" mass="0.3"
        contype="1" conaffinity="1" friction="0.3 0.005 0.0001" solref="0.02 0.6"/>
      <site name="mark" pos="0 0 0.03"/>
    </body>
  </worldbody>
"""

SYSTEM = System(
    name="thrown_box",
    title="small box thrown on a board",
    body_xml=XML,
    psi=(normal("friction", "geom/*/friction", 0.3, 0.06, 0), normal("contact_time", "geom/*/solref", 0.02, 0.003, 0)),
    noise_sd={"qpos/*/q*": 1e-3, "qpos/*": 3e-4, "qvel/*/w*": 5e-2, "qvel/*": 1e-2},
    start_position=(0.1, 0.1, 0.05, 1.5, 1.5, 1.5),
    start_velocity=(1.0, 1.0, 0.5, 6.0, 6.0, 6.0),
    reach=(3.0, 3.0, 1.0, 50.0, 50.0, 50.0),
    sampling=(0.005, 0.01),
    timestep=0.001,
    integrator="implicitfast",
    medium=' cone="elliptic"',
    touching=True,
    samples=100,
)
