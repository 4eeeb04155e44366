"""YuMi Pusher with physics that its model lacks: dry friction of an arm's joint, a rougher part of the table, a mass.

Reality is the same scene at a quarter of the timestep, with a law of its own and measurement noise; the policy pushes
as it always does. The study is diagnosed by a process that sees nothing else. Results go to
benchmarks/results/yumi_detective.jsonl.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from detective import FILES, FREE_Q, FREE_V, Case, Law, conceal, write
from jaxtyping import Float

from det2stoc_bayes.blind.laws import LAWS
from det2stoc_bayes.models import yumi_pusher as yumi
from det2stoc_bayes.models.yumi_pusher_policy import PERIOD, Pusher

LOG = Path(__file__).parent / "results" / "yumi_detective.jsonl"
FINER = 4  # steps of reality for one of the model
FITTED, HELD = 8, 3
PSI = {"friction": 0.28, "com": 0.035}
PATCH = 1.6  # of the table's friction, beyond a line across the boxes' way

COLUMNS = (
    *(f"qpos/free/{c}" for c in FREE_Q), *(f"qpos/{j}" for j in yumi.JOINTS),
    *(f"qvel/free/{c}" for c in FREE_V), *(f"qvel/{j}" for j in yumi.JOINTS), *(f"ctrl/{j}" for j in yumi.JOINTS),
)  # fmt: skip
STUDY = f"""{FILES}
[psi.friction]
target = "pair/*/friction"
index = [0, 1]
prior = {{ Uniform = {{ low = 0.1, high = 0.4 }} }}

[psi.com]
target = "body/block/pos"
index = [0]
prior = {{ Uniform = {{ low = -0.05, high = 0.05 }} }}

[noise]
"qpos/free/[xyz]" = {yumi.NOISE_PLACE}
"qpos/free/q*" = {yumi.NOISE_TURN / 2}
"qpos/yumi_*" = {yumi.NOISE_JOINT}
"qvel/*" = {yumi.NOISE_VELOCITY}
"""


def _nothing(data: mujoco.MjData) -> None:
    pass


def listed(name: str, element: str, **parameters: Any) -> Law:
    """A law of the concealing side that is written into the model."""

    def prepare(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
        law = LAWS[name].prepare
        assert law is not None
        law(model, element, parameters)
        return _nothing

    return prepare


def rough_table(ratio: float, x: float) -> Law:
    """So many times the friction of the table while the box's centre is beyond x [m]."""

    def prepare(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
        usual = model.pair_friction[:, :2].copy()

        def rub(data: mujoco.MjData) -> None:
            model.pair_friction[:, :2] = usual * (ratio if data.qpos[0] > x else 1.0)

        return rub

    return prepare


def recorded(law: Law | None, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Measured states (episodes, samples, 60) and commands (episodes, samples, 14) under one psi."""
    count = FITTED + HELD
    starts, worlds = yumi.drawn_starts(random, count), []
    for start in starts:
        spec = mujoco.MjSpec.from_file(str(yumi.MODEL))
        spec.option.timestep /= FINER
        model = spec.compile()
        model.pair_friction[:, :2], model.body_pos[model.body("block").id, 0] = PSI["friction"], PSI["com"]
        act = law(model) if law else _nothing
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        data.qpos[:], data.qvel[:] = start[:21], start[21:]
        worlds.append((model, data, act))
    states, actions = np.empty((count, yumi.NUM_STEPS + 1, 60)), np.empty((count, yumi.NUM_STEPS + 1, 14))
    pusher = Pusher(random)
    for k in range(yumi.NUM_STEPS + 1):
        full = np.stack([np.concatenate([d.qpos, d.qvel]) for _, d, _ in worlds])
        states[:, k] = yumi.measured(yumi.state_of(full), random)
        actions[:, k] = pusher(states[:, k])
        for (model, data, act), command in zip(worlds, actions[:, k], strict=True):
            data.ctrl[:] = command
            for _ in range(yumi.SUBSTEPS * FINER):
                act(data)
                mujoco.mj_step(model, data)
    return states, actions


def table(states: np.ndarray, actions: np.ndarray) -> Float[np.ndarray, "samples columns"]:
    """One recording, time first."""
    turn = np.empty((len(states), 4))
    for row, rotation in zip(turn, states[:, 45:54], strict=True):
        mujoco.mju_mat2Quat(row, rotation)
    time = PERIOD * np.arange(len(states))[:, None]
    return np.concatenate([time, states[:, 42:45], turn, states[:, :14], states[:, 54:], states[:, 14:28], actions], 1)


def write_study(folder: Path, law: Law | None, seed: int) -> Path:
    """A study's files, and nothing of what it conceals."""
    states, actions = recorded(law, np.random.default_rng([seed, 41]))
    stems = [f"recordings/push_{k:02d}" for k in range(FITTED)] + [
        f"holdout/push_{FITTED + k:02d}" for k in range(HELD)
    ]
    made = {stem: table(s, a) for stem, s, a in zip(stems, states, actions, strict=True)}
    return write(folder, yumi.MODEL, STUDY, COLUMNS, made)


CASES: dict[str, Case] = {
    "joint": (listed("coulomb_friction", "yumi_joint_2_l", force=0.5), "coulomb_friction", "yumi_joint_2_l"),
    "table": (rough_table(PATCH, 0.53), "friction_patch", "block/table"),
    "payload": (listed("payload_mass", "box", mass=0.15, offset=[0.0, 0.05, 0.05]), "payload_mass", "box"),
    "nothing": (None, "", ""),
}


if __name__ == "__main__":
    raise SystemExit(conceal(__doc__, CASES, ("joint", "table"), LOG, write_study))
