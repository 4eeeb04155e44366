"""Two simulations: reality, by an own fine Runge-Kutta scheme, and the believed model as a user runs it."""

import math

import mujoco
import numpy as np

from det2stoc_bayes.blind import laws
from det2stoc_bayes.blind.systems import System


def simulate_reality(
    system: System,
    psi: dict[str, float],
    effect: laws.Effect | None,
    start: np.ndarray,
    times: np.ndarray,
    commands: np.ndarray,
    finer: int = 4,
) -> np.ndarray:
    """Recorded columns without noise, (samples, columns).

    Kutta's 3/8 rule on MuJoCo's accelerations, at a step `finer` times below the believed one; forces are
    evaluated at every stage and steps end where the input switches.
    """
    model = system.compile(psi)
    laws.prepare(model, effect)
    data = mujoco.MjData(model)
    push = laws.force_of(model, effect)
    largest = system.timestep / finer
    qpos, qvel, qacc, warm = data.qpos, data.qvel, data.qacc, data.qacc_warmstart
    nv = model.nv
    state = start.copy()

    def rate(y: np.ndarray) -> np.ndarray:
        qpos[:] = y[:nv]
        qvel[:] = y[nv:]
        if push is not None:
            push(data)
        mujoco.mj_forward(model, data)
        warm[:] = qacc
        return np.concatenate((y[nv:], qacc))

    states = np.full((times.size, 2 * nv), np.nan)
    states[0] = state
    for k in range(times.size - 1):
        for duration, received in laws.pieces(effect, model, times, commands, k):
            data.ctrl[:] = received
            count = max(1, math.ceil(duration / largest - 1e-6))
            h = duration / count
            for _ in range(count):
                k1 = rate(state)
                k2 = rate(state + (h / 3.0) * k1)
                k3 = rate(state + h * (k2 - k1 / 3.0))
                k4 = rate(state + h * (k1 - k2 + k3))
                state = state + (h / 8.0) * (k1 + 3.0 * (k2 + k3) + k4)
        states[k + 1] = state
        if not np.abs(state).max() < 1e3:
            break
    return laws.measure(effect, system.columns(), states)


def simulate_believed(model: mujoco.MjModel, start: np.ndarray, times: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """The believed model's columns, (samples, columns); the sampling is a multiple of its timestep."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start[: model.nv], start[model.nv :]
    steps = round((times[1] - times[0]) / model.opt.timestep)
    states = np.empty((times.size, 2 * model.nv))
    for k in range(times.size):
        states[k, : model.nv], states[k, model.nv :] = data.qpos, data.qvel
        data.ctrl[:] = commands[k]
        mujoco.mj_step(model, data, nstep=steps)
    return states
