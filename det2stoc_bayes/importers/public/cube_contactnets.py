"""Tosses of the ContactNets cube onto a board (Pfrommer et al., CoRL 2020; Bianchini et al., CoRL 2023)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.importers.base import SourceError
from det2stoc_bayes.importers.public.base import Converted, Dataset
from det2stoc_bayes.importers.public.torch_files import read_tensor
from det2stoc_bayes.importers.write import Table

FITTED, HELD_OUT = range(40), range(40, 60)
PERIOD = 0.0068  # s
PATH = "assets/contactnets_cube/{}.pt"
POSE = [f"qpos/cube/{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
SPEED = [f"qvel/cube/{part}" for part in ("vx", "vy", "vz", "wx", "wy", "wz")]
MODEL = """<mujoco model="cube_contactnets">
  <option timestep="0.0017" integrator="implicitfast" cone="elliptic" gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="board" type="plane" pos="0 0 -0.0012" size="3 3 0.1" friction="0.3 0.005 0.0001" solref="0.01 1"/>
    <body name="cube" pos="0 0 0.0512">
      <freejoint name="cube"/>
      <inertial pos="0 0 0" mass="0.37" diaginertia="8.1e-4 8.1e-4 8.1e-4"/>
      <geom name="cube" type="box" size="0.0524 0.0524 0.0524" friction="0.3 0.005 0.0001" solref="0.01 1"/>
    </body>
  </worldbody>
</mujoco>
"""
_NOISE = {"qpos/cube/[xyz]": 0.0003, "qpos/cube/q[wxyz]": 0.003, "qvel/cube/v[xyz]": 0.01, "qvel/cube/w[xyz]": 0.2}
STUDY = """model = "model.xml"
recordings = "recordings/*.csv"
holdout = "holdout/*.csv"

[psi.friction]
target = "geom/*/friction"
index = [0]
prior = { TruncatedNormal = { loc = 0.3, scale = 0.2, low = 0.02 } }

[psi.contact_time]
target = "geom/*/solref"
index = [0]
prior = { TruncatedNormal = { loc = 0.01, scale = 0.008, low = 0.004 } }

[noise]
""" + "".join(f'"{pattern}" = {sd}\n' for pattern, sd in _NOISE.items())
SOURCE = """Tosses of a rigid cube onto a horizontal board (S. Pfrommer, M. Halm, M. Posa, "ContactNets", CoRL 2020;
B. Bianchini, M. Halm, M. Posa, "Simultaneous Learning of Contact and Continuous Dynamics", CoRL 2023).

- Pose from fiducial tags, a sample every 0.0068 s, smoothed by the authors. A row: quaternion (w x y z, body to world),
  position [m], angular velocity (rad/s, body frame), linear velocity (m/s, world frame).
- Tosses 0 to 39 -> `recordings`, 40 to 59 -> `holdout`.
- Converted: quaternions normalised, with one sign along a toss. The source's velocities belong to half a sample before
  their row; here each is the mean of its own and the next row's (the last row falls away).
- model.xml: the board lies 1.2 mm below z = 0, so that a resting cube's centre is where it is in the data.
- Noise: 0.3 mm, 7 mrad, 0.01 m/s, 0.2 rad/s. Mass, side and inertia are the source's."""


def convert(files: Mapping[str, Path]) -> Converted:
    """A toss a file."""

    def tosses(numbers: range) -> dict[str, Table]:
        return {f"toss_{i:02d}": _toss(read_tensor(files[PATH.format(i)]), f"{i}.pt") for i in numbers}

    return Converted(tosses(FITTED), tosses(HELD_OUT), STUDY)


def _toss(rows: Float[np.ndarray, "..."], where: str) -> Table:
    if rows.ndim != 2 or rows.shape[1] != 13 or len(rows) < 3:
        raise SourceError(f"{where}: found {rows.shape} numbers; allowed: rows of 13")
    turn, place, spin, speed = rows[:, :4], rows[:, 4:7], rows[:, 7:10], rows[:, 10:]
    turn = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    flips = (turn[1:] * turn[:-1]).sum(axis=1) < 0
    turn[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    speeds = np.column_stack([speed, spin])
    speeds = (speeds[:-1] + speeds[1:]) / 2
    time = PERIOD * np.arange(len(speeds))
    return Table(("time", *POSE, *SPEED), np.column_stack([time, place[:-1], turn[:-1], speeds]))


DATASET = Dataset(
    name="cube_contactnets",
    repository="DAIRLab/dair_pll",
    commit="523d372d8c2b50ea5ce77082d4f08879c753d963",
    files=tuple(PATH.format(i) for i in (*FITTED, *HELD_OUT)),
    license="BSD 3-Clause, Copyright (c) 2022, Dynamic Autonomy and Intelligent Robotics Lab",
    model=MODEL,
    source=SOURCE,
    convert=convert,
)
