"""Two simulations: reality, by an own fine Runge-Kutta scheme, and the believed model as a user runs it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.blind.laws import LAWS, Effect
from det2stoc_bayes.blind.laws.signals import Signals
from det2stoc_bayes.blind.systems import System

PREROLL = 0.1  # s before the first sample from which both simulations start, so that late readings have a past
DIVERGED = 1e4
PARTS = 32  # of a step in which a joint's stop is met or left


@dataclass(frozen=True)
class Run:
    """What is recorded, without noise, and the true states at the samples."""

    columns: Float[np.ndarray, "samples columns"]
    states: Float[np.ndarray, "samples state"]


class _World:
    """A model with effects: its rate of change, and what its sensors read."""

    def __init__(self, system: System, psi: dict[str, float], effects: Sequence[Effect]) -> None:
        self.model = model = system.compile(psi, general=True)
        laws = [(LAWS[e.name], e) for e in effects]
        for law, e in laws:
            if law.prepare is not None:
                law.prepare(model, e.element, e.parameters)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self.data = mujoco.MjData(model)
        self.advance = _advance(model)
        self.forces: list[Any] = [law.push(model, e.element, e.parameters) for law, e in laws if law.push is not None]
        self.mappings = [
            law.receive(model, model.actuator(e.element).id, e.parameters) for law, e in laws if law.receive is not None
        ]
        self.skew = float(np.prod([e.parameters["ratio"] for e in effects if e.name == "clock_skew"]))

        self.settling = [force for force in self.forces if hasattr(force, "settle")]
        single = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
        limited = np.flatnonzero(model.jnt_limited.astype(bool) & single)
        self._stopped, self._ranges = model.jnt_qposadr[limited], model.jnt_range[limited]

    def meets_stop(self, before: np.ndarray, after: np.ndarray) -> bool:
        """Whether a joint's limit, whose force sets in at once, is passed between two states."""
        if not self._stopped.size:
            return False
        beyond = [state[self._stopped, None] > self._ranges for state in (before, after)]
        return bool((beyond[0] != beyond[1]).any())

    @property
    def past(self) -> list[Any]:
        """What forces with memory keep."""
        return [force.kept for force in self.settling]

    @past.setter
    def past(self, kept: Sequence[Any]) -> None:
        for force, value in zip(self.settling, kept, strict=True):
            force.kept = value

    def settle(self, state: np.ndarray) -> None:
        """A step ends in this state."""
        self.data.qpos[:] = state[: self.model.nq]
        for force in self.settling:
            force.settle(self.data)

    def evaluate(self, state: np.ndarray, t: float, u: np.ndarray) -> None:
        """mj_forward in this state at this true time; laws know time by the recorded clock."""
        model, data, clock = self.model, self.data, t * self.skew
        data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
        for rewrite in self.mappings:
            rewrite(data, clock, u)
        data.ctrl[:] = u
        if self.forces:
            data.qfrc_applied[:] = 0.0
            for push in self.forces:
                push(data, clock)
        mujoco.mj_forward(model, data)
        data.qacc_warmstart[:] = data.qacc

    def rate(self, state: np.ndarray, t: float, u: np.ndarray) -> np.ndarray:
        self.evaluate(state, t, u)
        return np.concatenate((state[self.model.nq :], self.data.qacc))


def simulate_reality(
    system: System,
    psi: dict[str, float],
    effects: Sequence[Effect],
    start: np.ndarray,
    times: np.ndarray,
    commands: np.ndarray,
    finer: int = 4,
) -> Run:
    """Reality from `start`, PREROLL before the first of the recorded `times`; NaN where it diverges.

    Kutta's 3/8 rule on MuJoCo's accelerations, at a step `finer` times below the believed one; forces are
    evaluated at every stage and steps end where an input switches; where a stop is met they are finer still.
    """
    world = _World(system, psi, effects)
    true = times / world.skew
    names = system.columns()
    delay = np.zeros(len(names))
    for effect in effects:
        if effect.name == "sensor_delay":
            delay[names.index(effect.element)] += effect.parameters["delay"]
    stops = np.concatenate([[true[0] - PREROLL], true, *(true - d for d in np.unique(delay[delay > 0.0]))])
    signals = Signals(world.model, effects, true, commands, stops)
    states, pasts = _integrate(world, start, signals, system.timestep / finer)
    read = _reader(system, world.model)
    at = [np.searchsorted(signals.edges, true - d - 1e-8) for d in delay]
    columns = np.full((times.size, len(names)), np.nan)
    for edge in np.unique(np.concatenate([*at, np.searchsorted(signals.edges, true - 1e-8)])):
        if np.isfinite(states[edge]).all():
            if world.model.nsensor:
                t, world.past = float(signals.edges[edge]), pasts[edge]
                world.evaluate(states[edge], t, signals.at(edge, t))
            values = read(states[edge], world.data)
            for c, where in enumerate(at):
                columns[where == edge, c] = values[c]
    for effect in effects:
        record = LAWS[effect.name].record
        if record is not None:
            c = names.index(effect.element)
            columns[:, c] = record(columns[:, c], times, effect.parameters)
    return Run(columns, states[np.searchsorted(signals.edges, true - 1e-8)])


def _integrate(world: _World, start: np.ndarray, signals: Signals, largest: float) -> tuple[np.ndarray, list]:
    """True states at the edges, and what forces with memory keep there."""
    states = np.full((signals.edges.size, start.size), np.nan)
    states[0] = state = start.copy()
    world.settle(state)
    pasts = [world.past]
    for piece in range(signals.edges.size - 1):
        t, duration = signals.edges[piece], signals.edges[piece + 1] - signals.edges[piece]
        count = max(1, math.ceil(duration / largest - 1e-6))
        h = duration / count
        for _ in range(count):
            after = _step(world, state, t, h, signals, piece)
            if world.meets_stop(state, after):
                for part in range(PARTS):
                    state = _step(world, state, t + part * h / PARTS, h / PARTS, signals, piece)
                    world.settle(state)
            else:
                state = after
                world.settle(state)
            t += h
        pasts.append(world.past)
        if not np.abs(state).max() < DIVERGED:
            break
        states[piece + 1] = state
    return states, pasts


def _step(world: _World, state: np.ndarray, t: float, h: float, signals: Signals, piece: int) -> np.ndarray:
    """One step of Kutta's 3/8 rule."""
    advance, late = world.advance, t + 2.0 * h / 3.0
    k1 = world.rate(state, t, signals.at(piece, t))
    k2 = world.rate(advance(state, (h / 3.0) * k1), t + h / 3.0, signals.at(piece, t + h / 3.0))
    k3 = world.rate(advance(state, h * (k2 - k1 / 3.0)), late, signals.at(piece, late))
    k4 = world.rate(advance(state, h * (k1 - k2 + k3)), t + h, signals.at(piece, t + h))
    return advance(state, (h / 8.0) * (k1 + 3.0 * (k2 + k3) + k4))


def _advance(model: mujoco.MjModel) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A function that moves a state along a tangent vector."""
    nq, nv = model.nq, model.nv
    if nq == nv:
        return lambda state, step: state + step

    def advance(state: np.ndarray, step: np.ndarray) -> np.ndarray:
        qpos = state[:nq].copy()
        mujoco.mj_integratePos(model, qpos, step[:nv], 1.0)
        return np.concatenate((qpos, state[nq:] + step[nv:]))

    return advance


def shifted(model: mujoco.MjModel, state: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A state (qpos, qvel) moved along a tangent vector (2 nv)."""
    return _advance(model)(state, step)


def _reader(system: System, model: mujoco.MjModel) -> Callable[[np.ndarray, mujoco.MjData], np.ndarray]:
    """A function that picks the measured columns of a state and its sensors."""
    nq, position, velocity = model.nq, "qpos" in system.measured, "qvel" in system.measured

    def read(state: np.ndarray, data: mujoco.MjData) -> np.ndarray:
        return np.concatenate((state[:nq] if position else (), state[nq:] if velocity else (), data.sensordata))

    return read


def simulate_believed(
    system: System, model: mujoco.MjModel, start: np.ndarray, times: np.ndarray, commands: np.ndarray
) -> Float[np.ndarray, "samples columns"]:
    """The believed model's columns from `start`, PREROLL before the first sample.

    A sample is where its nearest step is: exact where the sampling is a multiple of the timestep.
    """
    data, read, nq = mujoco.MjData(model), _reader(system, model), model.nq
    data.qpos[:], data.qvel[:] = start[:nq], start[nq:]
    step = model.opt.timestep
    counts = np.diff(np.rint((times - times[0]) / step).astype(int), append=0)
    if model.nu:
        data.ctrl[:] = commands[0]
    mujoco.mj_step(model, data, nstep=round(PREROLL / step))
    rows = []
    for k in range(times.size):
        if model.nu:
            data.ctrl[:] = commands[k]
        if model.nsensor:
            mujoco.mj_forward(model, data)
        rows.append(read(np.concatenate((data.qpos, data.qvel)), data))
        if k < times.size - 1:
            mujoco.mj_step(model, data, nstep=int(counts[k]))
    return np.array(rows)
