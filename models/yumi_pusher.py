"""A dual-arm robot pushes a box of unknown friction and centre of mass to a goal: the thesis' second scene.

psi: friction between table and box, x of the hidden block in the box [m]. The state has 60 numbers: positions and
velocities of 14 joints, place and quaternion of two end effectors, and of the box its place, rotation matrix (by
rows), linear (world) and angular velocity (body). Each is measured with noise. The block reaches out of the box where
its x is not 0; it stands on the table as the box does, or a box with its block's mass beyond its edge would fall over.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Bool, Float
from joblib import cpu_count
from scipy.spatial.transform import Rotation

from det2stoc_bayes.engines.quiet import UNTIMED
from det2stoc_bayes.models._arm import Arm
from det2stoc_bayes.models._population import Normals, Uniforms
from det2stoc_bayes.models._runs import Runs

MODEL = Path(__file__).with_suffix(".xml")
NAMES = ("friction", "com")
UNITS = ("1", "m")
SIDES = ("left", "right")
JOINTS = tuple(f"yumi_joint_{i}_{side[0]}" for side in SIDES for i in (1, 2, 7, 3, 4, 5, 6))
STATE = (
    *JOINTS, *(f"{joint}'" for joint in JOINTS),
    *(f"{side} {c}" for side in SIDES for c in ("x", "y", "z", "qw", "qx", "qy", "qz")),
    *("x", "y", "z"), *(f"R{i}{j}" for i in range(3) for j in range(3)), *("vx", "vy", "vz"), *("wx", "wy", "wz"),
)  # fmt: skip
BLOCKS = {
    "joint positions": slice(0, 14), "joint velocities": slice(14, 28), "end effectors": slice(28, 42),
    "box place": slice(42, 45), "box rotation": slice(45, 54), "box velocity": slice(54, 60),
}  # fmt: skip
NUM_STEPS = 100
SUBSTEPS = 10  # of 4 ms
CHUNK = 512  # episodes that are stepped together
LEAST = (0.01, -np.inf)  # of psi: friction is positive
NOISE_JOINT, NOISE_PLACE, NOISE_TURN, NOISE_VELOCITY = 1e-3, 1e-4, 1e-3, 1e-3  # rad (/s), m, rad, m/s and rad/s
GOAL = np.array([0.63, 0.0])
CENTRE, HALF_SIDE = np.array([0.46, 0.0]), 0.1  # of the square that boxes start in [m]
ASKEW = 0.2  # rad: how far a box may be turned off the goal at first
HEIGHT = 0.1556  # of the box's centre on the table
HOME = np.array([0.75, 0.70, -0.04, 0.65, 0.03, -1.42, -1.21])  # of the left arm; the right one mirrors it
MIRROR = np.array([-1, 1, -1, 1, -1, 1, -1.0])
REALITY = Normals((0.28, 0.035), (0.01, 0.005))
PRIOR = Uniforms((0.1, -0.05), (0.4, 0.05))

Act = Callable[[Float[np.ndarray, "sims 60"]], Float[np.ndarray, "sims 14"]]


def load_model() -> mujoco.MjModel:
    """The scene."""
    return mujoco.MjModel.from_xml_path(str(MODEL))


@cache
def arms() -> tuple[Arm, Arm]:
    """The left and the right one, up to their fingers' tips."""
    model = load_model()
    left, right = (Arm.of(model, f"{side}_tip", 7) for side in SIDES)
    return left, right


def drawn_starts(random: np.random.Generator, count: int) -> Float[np.ndarray, "count 41"]:
    """qpos and qvel at rest: both arms at home, the box anywhere in the square, its face about to the goal."""
    full = np.zeros((count, 41))
    full[:, :2] = CENTRE + random.uniform(-HALF_SIDE, HALF_SIDE, (count, 2))
    full[:, 2] = HEIGHT
    ahead = GOAL - full[:, :2]
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0]) + random.uniform(-ASKEW, ASKEW, count)
    full[:, 3], full[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    full[:, 7:14], full[:, 14:21] = HOME, HOME * MIRROR
    return full


def prepared(model: mujoco.MjModel, psi: Float[np.ndarray, "sims 2"], num_threads: int = 0) -> mujoco.batch.Batch:
    """Simulations of the scene, one a psi."""
    batch = mujoco.batch.Batch(model, len(psi), num_threads or cpu_count())
    batch.expand("pair_friction").reshape(len(psi), model.npair, 5)[:, :, :2] = psi[:, :1, None]
    batch.expand("body_pos").reshape(len(psi), model.nbody, 3)[:, model.body("block").id, 0] = psi[:, 1]
    batch.set_const()
    return batch


@UNTIMED
def simulate(
    psi: Float[np.ndarray, "sims 2"],
    start: Float[np.ndarray, "sims 41"],
    act: Callable[[slice], Act],
    random: np.random.Generator,
    *,
    num_steps: int = NUM_STEPS,
    num_threads: int = 0,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Runs:
    """Episodes from states; `act` gives what some of them are commanded by, which sees what is measured."""
    model, count = load_model(), len(psi)
    states = np.empty((count, num_steps + 1, len(STATE)))
    actions, full = np.empty((count, num_steps, model.nu)), np.empty((count, num_steps + 1, 41))
    for begin in range(0, count, CHUNK):
        rows = slice(begin, min(begin + CHUNK, count))
        batch, command = prepared(model, psi[rows], num_threads), act(rows)
        qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        qpos[:], qvel[:] = start[rows, :21], start[rows, 21:]
        for k in range(num_steps + 1):
            full[rows, k] = np.concatenate([qpos, qvel], 1)
            states[rows, k] = measured(state_of(full[rows, k]), random)
            if k < num_steps:
                actions[rows, k] = ctrl[:] = command(states[rows, k])
                batch.step(nstep=SUBSTEPS)
        progress(rows.stop, count)
    return Runs(states, actions, full)


def after(
    psi: Float[np.ndarray, "sims 2"], start: Float[np.ndarray, "sims 41"], actions: Float[np.ndarray, "sims steps 14"]
) -> Float[np.ndarray, "sims samples 41"]:
    """qpos and qvel that given commands lead to, the start among them."""

    def replayed(rows: slice) -> Act:
        left = iter(np.moveaxis(actions[rows], 1, 0))
        return lambda _: next(left)

    return simulate(psi, start, replayed, np.random.default_rng(0), num_steps=actions.shape[1]).full


def state_of(full: Float[np.ndarray, "rows 41"]) -> Float[np.ndarray, "rows 60"]:
    """The 60 numbers without noise, from qpos and qvel."""
    out = np.empty((len(full), len(STATE)))
    out[:, :14], out[:, 14:28] = full[:, 7:21], full[:, 27:]
    for i, arm in enumerate(arms()):
        place, turn, _ = arm.pose(full[:, 7 + 7 * i : 14 + 7 * i])
        out[:, 28 + 7 * i : 31 + 7 * i] = place
        out[:, 31 + 7 * i : 35 + 7 * i] = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    out[:, 42:45], out[:, 54:] = full[:, :3], full[:, 21:27]
    out[:, 45:54] = Rotation.from_quat(full[:, 3:7], scalar_first=True).as_matrix().reshape(-1, 9)
    return _same_side(out)


def measured(state: Float[np.ndarray, "rows 60"], random: np.random.Generator) -> Float[np.ndarray, "rows 60"]:
    """States with noise; rotations stay rotations."""
    out, count = state.copy(), len(state)

    def turned(rotation: Rotation) -> Rotation:
        return rotation * Rotation.from_rotvec(NOISE_TURN * random.standard_normal((count, 3)))

    out[:, :28] += NOISE_JOINT * random.standard_normal((count, 28))
    for i in (28, 35):
        out[:, i : i + 3] += NOISE_PLACE * random.standard_normal((count, 3))
        pose = Rotation.from_quat(state[:, i + 3 : i + 7], scalar_first=True)
        out[:, i + 3 : i + 7] = turned(pose).as_quat(scalar_first=True)
    out[:, 42:45] += NOISE_PLACE * random.standard_normal((count, 3))
    out[:, 45:54] = turned(Rotation.from_matrix(state[:, 45:54].reshape(-1, 3, 3))).as_matrix().reshape(-1, 9)
    out[:, 54:] += NOISE_VELOCITY * random.standard_normal((count, 6))
    return _same_side(out)


def noise_variance(state: Float[np.ndarray, "rows 60"]) -> Float[np.ndarray, "rows 60"]:
    """Of what `measured` adds, to first order in the turns: R_ij moves by R_i x d, a quaternion q by q (0, d / 2)."""
    out = np.empty_like(state)
    out[:, :28] = NOISE_JOINT**2
    for i in (28, 35):
        out[:, i : i + 3] = NOISE_PLACE**2
        out[:, i + 3 : i + 7] = (NOISE_TURN / 2) ** 2 * (1 - state[:, i + 3 : i + 7] ** 2)
    out[:, 42:45], out[:, 54:] = NOISE_PLACE**2, NOISE_VELOCITY**2
    out[:, 45:54] = NOISE_TURN**2 * (1 - state[:, 45:54] ** 2)
    return out


def _same_side(state: Float[np.ndarray, "rows 60"]) -> Float[np.ndarray, "rows 60"]:
    """Of q and -q, one pose, that nearer to a hand that points down, its x to the right (right hand: left)."""
    for i, side in ((31, -1), (38, 1)):
        state[state[:, i + 1] + side * state[:, i + 2] < 0, i : i + 4] *= -1
    return state


def at_goal(states: Float[np.ndarray, "episodes samples 60"], within: float = 0.03) -> Bool[np.ndarray, " episodes"]:
    """Whether the box's centre ends near the goal, and the box stands."""
    last = states[:, -1]
    return (np.linalg.norm(last[:, 42:44] - GOAL, axis=1) < within) & (last[:, 53] > 0.95)
