"""A box with a hidden block slides down a slope in the wind and may hit a post: the thesis' first scene.

psi: friction between floor and box, x of the hidden block [m], x of the wind [m/s]. Each episode starts at the same
state under a new psi. The state has 18 numbers: position 3, rotation matrix 9 (by rows), linear velocity 3 (world),
angular velocity 3 (body).
"""

from collections.abc import Callable
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from det2stoc_bayes.models._population import Normals

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


REALITY = Normals((0.23, 0.11, -1.7), (0.01, 0.04, 0.05))
PRIOR = Normals((0.25, 0.0, -1.0), (0.1, 0.2, 1.0), (0.1, -0.25, -3.0), (0.4, 0.25, 1.0))
CALM_PRIOR = Normals((0.25, 0.0, 0.0), (0.1, 0.2, 0.5), (0.1, -0.25, -1.0), (0.4, 0.25, 1.0))  # truth outside


def load_model() -> mujoco.MjModel:
    """The scene."""
    return mujoco.MjModel.from_xml_path(str(MODEL))


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
    batch = mujoco.batch.Batch(model, len(psi), num_threads)
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
