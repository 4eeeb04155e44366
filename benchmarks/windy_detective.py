"""Windy Slope with physics that its model lacks: a rougher part of the slope, a wind that swells; and with nothing.

Reality is the scene at a quarter of the timestep by another integrator, with a law of its own and measurement noise;
boxes begin elsewhere each time, sliding and turning. The study is diagnosed by a process that sees nothing else.
Results go to benchmarks/results/windy_detective.jsonl.
"""

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from detective import FILES, FREE_Q, FREE_V, Case, Law, conceal, write
from jaxtyping import Float

from det2stoc_bayes.models import windy_slope

LOG = Path(__file__).parent / "results" / "windy_detective.jsonl"
TIMESTEP = 0.0005  # s, of reality; the model's is 0.002
PERIOD, SAMPLES = 0.02, 76
FITTED, HELD = 8, 3
PSI = {"friction": 0.23, "com": 0.11, "wind": -1.7}
PATCH, LINE = 1.5, -1.0  # times the friction, beyond this y [m]
GUST, FREQUENCY, PHASE = 1.0, 1.1, 0.4  # m/s, Hz, rad: a wind beside the steady one
TILT = np.deg2rad(25.0)
COLUMNS = (*(f"qpos/free/{c}" for c in FREE_Q), *(f"qvel/free/{c}" for c in FREE_V))
STUDY = f"""{FILES}
[psi.friction]
target = "pair/*/friction"
index = [0, 1]
prior = {{ Uniform = {{ low = 0.05, high = 0.5 }} }}

[psi.com]
target = "body/block/pos"
index = [0]
prior = {{ Normal = {{ loc = 0.0, scale = 0.1 }} }}

[psi.wind]
target = "opt/wind"
index = [0]
prior = {{ Normal = {{ loc = 0.0, scale = 2.0 }} }}

[noise]
"qpos/*" = {windy_slope.NOISE[0]}
"qvel/*" = {windy_slope.NOISE[1]}
"""


def rough_slope(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
    """More friction where the box's centre is beyond a line."""
    usual = model.pair_friction[:, :2].copy()

    def rub(data: mujoco.MjData) -> None:
        model.pair_friction[:, :2] = usual * (PATCH if data.qpos[1] < LINE else 1.0)

    return rub


def swelling_wind(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
    """A sine of time beside the steady wind."""
    steady = model.opt.wind.copy()

    def blow(data: mujoco.MjData) -> None:
        model.opt.wind[0] = steady[0] + GUST * np.sin(2 * np.pi * FREQUENCY * data.time + PHASE)

    return blow


def recorded(law: Law | None, random: np.random.Generator) -> Float[np.ndarray, "samples columns"]:
    """One recording, time first."""
    spec = mujoco.MjSpec.from_file(str(windy_slope.MODEL))
    spec.option.timestep, spec.option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    model.pair_friction[:, :2], model.opt.wind[0] = PSI["friction"], PSI["wind"]
    model.body_pos[model.body("block").id, 0] = PSI["com"]
    act = law(model) if law else lambda _: None
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    down, speed = random.uniform(0.0, 0.5), abs(random.normal(0.0, 0.5))
    data.qpos[:3] += random.uniform(-0.3, 0.3), -down * np.cos(TILT), -down * np.sin(TILT)
    data.qvel[:3] = random.normal(0.0, 0.3), -speed * np.cos(TILT), -speed * np.sin(TILT)
    data.qvel[5] = random.normal(0.0, 0.2)
    noise, rows = np.repeat(windy_slope.NOISE, (model.nq, model.nv)), []
    for k in range(SAMPLES):
        state = np.concatenate([data.qpos, data.qvel]) + noise * random.standard_normal(model.nq + model.nv)
        state[3:7] /= np.linalg.norm(state[3:7])
        rows.append((PERIOD * k, *state))
        for _ in range(round(PERIOD / TIMESTEP)):
            act(data)
            mujoco.mj_step(model, data)
    return np.array(rows)


def write_study(folder: Path, law: Law | None, seed: int) -> Path:
    """A study's files, and nothing of what it conceals."""
    random = np.random.default_rng([seed, 43])
    stems = [f"recordings/slide_{k:02d}" for k in range(FITTED)]
    stems += [f"holdout/slide_{FITTED + k:02d}" for k in range(HELD)]
    return write(folder, windy_slope.MODEL, STUDY, COLUMNS, {stem: recorded(law, random) for stem in stems})


CASES: dict[str, Case] = {
    "patch": (rough_slope, "friction_patch", "box/floor"),
    "wind": (swelling_wind, "periodic_wind", "world"),
    "nothing": (None, "", ""),
}

if __name__ == "__main__":
    raise SystemExit(conceal(__doc__, CASES, tuple(CASES), LOG, write_study))
