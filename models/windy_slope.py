"""A box with a hidden block slides down a slope in the wind and may hit a post: the thesis' first scene.

psi: friction between floor and box, x of the hidden block [m], x of the wind [m/s]. Each episode starts at the same
state under a new psi. The state has 18 numbers: position 3, rotation matrix 9 (by rows), linear velocity 3 (world),
angular velocity 3 (body).

As a problem of inference: ten recordings of the first 0.8 s, which no box needs to reach the post (`_windowed`).
"""

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Float
from joblib import cpu_count
from scipy.spatial.transform import Rotation

from det2stoc_bayes.engines.quiet import UNTIMED
from det2stoc_bayes.models._population import Normals
from det2stoc_bayes.models._windowed import Windowed
from det2stoc_bayes.priors import Prior
from det2stoc_bayes.study import Parameter, Target

MODEL = Path(__file__).with_suffix(".xml")
NAMES = ("friction", "com", "wind")
UNITS = ("1", "m", "m/s")
STATE = (
    *("x", "y", "z"), *(f"R{i}{j}" for i in range(3) for j in range(3)), *("vx", "vy", "vz"), *("wx", "wy", "wz"),
)  # fmt: skip
NUM_STEPS = 100
LEAST = (0.01, -np.inf, -np.inf)  # of psi: friction is positive
SUBSTEPS = 20  # of 2 ms
CHUNK = 512  # episodes that are stepped together
HORIZONS = (4, 8, 12, 16, 20)  # samples after the start at which a window is seen
NOISE = (5e-4, 5e-3)  # sd of recorded qpos [m; a quaternion's numbers] and qvel [m/s, rad/s]

REALITY = Normals((0.23, 0.11, -1.7), (0.01, 0.04, 0.05))
PRIOR = Normals((0.25, 0.0, -1.0), (0.1, 0.2, 1.0), (0.1, -0.25, -3.0), (0.4, 0.25, 1.0))
CALM_PRIOR = Normals((0.25, 0.0, 0.0), (0.1, 0.2, 0.5), (0.1, -0.25, -1.0), (0.4, 0.25, 1.0))  # truth outside


def load_model() -> mujoco.MjModel:
    """The scene."""
    return mujoco.MjModel.from_xml_path(str(MODEL))


@UNTIMED
def simulate(
    psi: Float[np.ndarray, "episodes 3"],
    *,
    num_steps: int = NUM_STEPS,
    start: Float[np.ndarray, "episodes 13"] | None = None,
    num_threads: int = 0,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Float[np.ndarray, "episodes samples 18"]:
    """States of episodes, the initial one first; `start` holds qpos and qvel."""
    model = load_model()
    out = np.empty((len(psi), num_steps + 1, len(STATE)))
    for begin in range(0, len(psi), CHUNK):
        rows = slice(begin, min(begin + CHUNK, len(psi)))
        batch = prepared(model, psi[rows], num_threads)
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        if start is not None:
            qpos[:], qvel[:] = start[rows, :7], start[rows, 7:]
        write_state(qpos, qvel, out[rows, 0])
        for k in range(num_steps):
            batch.step(nstep=SUBSTEPS)
            write_state(qpos, qvel, out[rows, k + 1])
        progress(rows.stop, len(psi))
    return out


def prepared(model: mujoco.MjModel, psi: Float[np.ndarray, "episodes 3"], num_threads: int) -> mujoco.batch.Batch:
    """Simulations of the scene at its initial state, one a psi."""
    batch = mujoco.batch.Batch(model, len(psi), num_threads or cpu_count())
    block = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "block")
    batch.expand("pair_friction").reshape(len(psi), -1)[:, :2] = psi[:, :1]
    batch.expand("body_pos").reshape(len(psi), model.nbody, 3)[:, block, 0] = psi[:, 1]
    batch.expand("opt.wind").reshape(len(psi), 3)[:, 0] = psi[:, 2]
    batch.set_const()
    return batch


def write_state(qpos: np.ndarray, qvel: np.ndarray, out: np.ndarray) -> None:
    """18 numbers from MuJoCo's 13."""
    out[:, :3], out[:, 12:] = qpos[:, :3], qvel
    out[:, 3:12] = Rotation.from_quat(qpos[:, 3:7], scalar_first=True).as_matrix().reshape(-1, 9)


def full_state(state: Float[np.ndarray, "episodes 18"]) -> Float[np.ndarray, "episodes 13"]:
    """qpos and qvel of states, the nearest rotation taken."""
    quaternion = Rotation.from_matrix(state[:, 3:12].reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return np.concatenate([state[:, :3], quaternion, state[:, 12:]], 1)


def windows(states: Float[np.ndarray, "episodes samples 18"]) -> Float[np.ndarray, "episodes features"]:
    """At each horizon place, turn since the start (a rotation vector, rad), and speeds."""
    seen = states[:, list(HORIZONS)]
    first = Rotation.from_matrix(states[0, 0, 3:12].reshape(3, 3)).inv()
    turn = (first * Rotation.from_matrix(seen[..., 3:12].reshape(-1, 3, 3))).as_rotvec().reshape(*seen.shape[:2], 3)
    return np.concatenate([seen[..., :3], turn, seen[..., 12:]], -1).reshape(len(states), -1)


def _parameter(k: int, target: str, index: tuple[int, ...]) -> Parameter:
    bounds = {"loc": PRIOR.loc[k], "scale": PRIOR.scale[k], "low": PRIOR.low[k], "high": PRIOR.high[k]}
    return Parameter(NAMES[k], Target.parse(target), index, Prior("TruncatedNormal", bounds), "trajectory")


class WindySlope(Windowed):
    """Population and trajectories' psi from ten windows."""

    name: ClassVar = "windy_slope"
    parameters: ClassVar = (
        _parameter(0, "pair/floor_box/friction", (0, 1)),
        _parameter(1, "body/block/pos", (0,)),
        _parameter(2, "opt/wind", (0,)),
    )
    reality: ClassVar = REALITY
    # Noise s of a quaternion's numbers turns by 2 s.
    noise: ClassVar = np.tile([NOISE[0]] * 3 + [2 * NOISE[0]] * 3 + [NOISE[1]] * 6, len(HORIZONS))

    def seen(self, psi: Float[np.ndarray, "sims 3"]) -> Float[np.ndarray, "sims features"]:
        """In MuJoCo's C engine."""
        return windows(simulate(psi, num_steps=HORIZONS[-1]))

    @property
    def settings(self) -> tuple[object, ...]:
        """With the horizons."""
        return (*super().settings, HORIZONS, mujoco.__version__)


PROBLEM = WindySlope()
