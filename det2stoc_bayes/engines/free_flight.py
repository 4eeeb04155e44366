"""How free bodies fall while they touch nothing: there neither contact nor psi has a say.

A clock that runs fast, lengths in another unit or by a camera that is a few per cent out, and another gravity show in
it, and are what contact would be blamed for.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from det2stoc_bayes.engines import contacts
from det2stoc_bayes.engines.layout import FREE
from det2stoc_bayes.engines.state_columns import state_columns

if TYPE_CHECKING:
    from det2stoc_bayes.problem import Problem
    from det2stoc_bayes.recording import Recording
    from det2stoc_bayes.study import Study

APART = 2  # samples beside a touch that are no part of a flight: it may last longer than what was recorded
CLEAR = 10.0  # noise sds of a place, by which a body in flight is away from all others
GAP = 3.0  # times the usual interval between samples, in which something may have been touched
LEFT = 3.0  # noise sds (rms) that no parabola leaves of a flight: something was touched between two samples
LEAST_SAMPLES, LEAST_FLIGHTS = 8, 5  # of a flight; of a body
CHANCE, LEAST = 1e-4, 0.1  # that luck makes a component contradict, and m/s2 by which it must
SAFE = ("geom", "pair")  # kinds of which psi and what is known of recordings change contact alone


@dataclass(frozen=True)
class Fall:
    """Mean acceleration of a free body's centre of mass in flights, 1 standard error of it, and the model's [m/s2]."""

    body: str
    flights: int
    acceleration: tuple[float, float, float]
    error: tuple[float, float, float]
    believed: tuple[float, float, float]

    @property
    def contradicts(self) -> bool:
        """Whether flights are surely not what the model's gravity makes them."""
        apart, surely = np.abs(np.subtract(self.acceleration, self.believed)), stats.t.isf(CHANCE / 2, self.flights - 1)
        return bool(((apart > surely * np.array(self.error)) & (apart > LEAST)).any())

    @property
    def text(self) -> str:
        """What contradicts, in a sentence."""
        mean, error, believed = (
            ", ".join(f"{v:.{digits}f}" for v in values)
            for values, digits in ((self.acceleration, 3), (self.error, 3), (self.believed, 2))
        )
        return (
            f"In {self.flights} stretches in which {self.body} touches nothing its centre of mass accelerates by "
            f"({mean}) +- ({error}) m/s2, in the model by ({believed}): recorded lengths, the clock or gravity are "
            "off, or something acts in flight."
        )


def falls(problem: "Problem") -> tuple[Fall, ...]:
    """Of every free body that flies often enough, over all of a study's recordings, held-out ones too.

    None where something else than gravity may act in flight by the model itself, where psi or what is known of a
    recording sets more than contact, or where a position is not recorded.
    """
    model, study = problem.simulator.model, problem.simulator.study
    bodies = [int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == FREE]
    noise = _noise(problem)
    if not bodies or noise is None or _acted_on(model) or not _only_contact_is_set(study):
        return ()
    near = _wider(model, CLEAR * noise)
    rates: dict[int, list[tuple[float, np.ndarray]]] = {body: [] for body in bodies}
    for recording in (*study.recordings, *study.holdout):
        qpos = _positions(model, recording)
        for body, stretch in _flights(near, recording.time, qpos, bodies):
            rate = _acceleration(recording.time[stretch], _centre(model, qpos[stretch], body), noise)
            rates[body] += [] if rate is None else [rate]
    return tuple(_fall(model, body, each) for body, each in rates.items() if len(each) >= LEAST_FLIGHTS)


def _acted_on(model: mujoco.MjModel) -> bool:
    """Whether more, or less, than gravity may act on what a free joint moves and nothing touches."""
    joints, free = model.jnt_type == FREE, np.isin(model.jnt_type[model.dof_jntid], FREE)
    springs = model.jnt_stiffness[joints].any() or model.jnt_stiffnesspoly[joints].any()
    losses = [getattr(model, n)[free].any() for n in ("dof_damping", "dof_dampingpoly", "dof_frictionloss")]
    weightless = model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    counts = model.nu, model.neq, model.ntendon, model.nflex, model.nplugin
    medium = model.opt.density, model.opt.viscosity
    return bool(any(counts) or any(medium) or weightless or springs or any(losses) or model.body_gravcomp.any())


def _only_contact_is_set(study: "Study") -> bool:
    """Whether psi, and what is known of recordings, leave free flight as the model has it."""
    known = (target for table in study.known.values() for target in table)
    return all(target.kind in SAFE for target in (*(p.target for p in study.parameters), *known))


def _noise(problem: "Problem") -> float | None:
    """The largest noise of a free body's place, m; None where none is recorded."""
    model = problem.simulator.model
    first = model.jnt_qposadr[model.jnt_type == FREE]
    recorded = [
        float(problem.noise[j])
        for (source, k), j in state_columns(model, problem.segments.columns).items()
        if source == "qpos" and ((first <= k) & (k < first + 3)).any()
    ]
    return max(recorded, default=None)


def _wider(model: mujoco.MjModel, clearance: float) -> mujoco.MjModel:
    """The model with geoms that touch from so far away on; margins of two geoms add up."""
    near = copy(model)
    near.geom_margin[:] += 0.5 * clearance
    near.body_margin[:] += 0.5 * clearance
    near.pair_margin[:] += clearance
    return near


def _positions(model: mujoco.MjModel, recording: "Recording") -> Float[np.ndarray, "samples nq"]:
    """NaN where one was not recorded."""
    qpos = np.full((len(recording.time), model.nq), np.nan)
    for (source, k), j in state_columns(model, recording.columns).items():
        if source == "qpos":
            qpos[:, k] = recording.values[:, j]
    return qpos


def _flights(
    near: mujoco.MjModel, time: Float[np.ndarray, " samples"], qpos: Float[np.ndarray, "samples nq"], bodies: list[int]
) -> Iterator[tuple[int, slice]]:
    """Each body's stretches in which nothing of it is near anything; a sample that lacks a position ends one."""
    recorded = np.isfinite(qpos).all(1)
    pairs, touching = contacts.touching(near, qpos[recorded])
    roots = near.body_rootid[near.geom_bodyid[np.array(pairs, int).reshape(-1, 2)]]
    begins = np.flatnonzero(np.diff(time) > GAP * np.median(np.diff(time))) + 1
    for body in bodies:
        flying = np.zeros(len(qpos), bool)
        flying[recorded] = ~touching[:, (roots == body).any(1)].any(1)
        for part in np.split(np.arange(len(time)), begins):
            yield from ((body, stretch) for stretch in _stretches(flying, int(part[0]), int(part[-1]) + 1))


def _stretches(flying: Bool[np.ndarray, " samples"], begin: int, end: int) -> Iterator[slice]:
    """Samples of each flight between two, that are APART from what touches before and after it."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flying[begin:end], [False]]).astype(int)))
    for first, last in begin + edges.reshape(-1, 2):
        first, last = int(first) + APART * (first > begin), int(last) - APART * (last < end)
        if last - first >= LEAST_SAMPLES:
            yield slice(first, last)


def _centre(model: mujoco.MjModel, qpos: Float[np.ndarray, "samples nq"], body: int) -> Float[np.ndarray, "samples 3"]:
    """Centre of mass of a body with all that hangs on it."""
    data, out = mujoco.MjData(model), np.zeros((len(qpos), 3))
    for k, state in enumerate(qpos):
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        out[k] = data.subtree_com[body]
    return out


def _acceleration(
    time: Float[np.ndarray, " samples"], place: Float[np.ndarray, "samples 3"], noise: float
) -> tuple[float, Float[np.ndarray, "3"]] | None:
    """What a parabola's acceleration counts (inverse variance by noise of 1), and itself; None where it is none."""
    t = time - time.mean()
    design = np.stack([np.ones_like(t), t, 0.5 * t**2], 1)
    parabola = np.linalg.lstsq(design, place, rcond=None)[0]
    left = np.sqrt(((place - design @ parabola) ** 2).sum(0) / (len(t) - 3))
    return None if (left > LEFT * noise).any() else (1 / float(np.linalg.inv(design.T @ design)[2, 2]), parabola[2])


def _fall(model: mujoco.MjModel, body: int, each: list[tuple[float, np.ndarray]]) -> Fall:
    """Flights pooled by the inverse variances of their accelerations, up to a scale that their scatter gives."""
    weight, rates = np.array([w for w, _ in each])[:, None], np.stack([a for _, a in each])
    weight = weight / weight.sum()
    mean = (weight * rates).sum(0)
    error = np.sqrt((weight * (rates - mean) ** 2).sum(0) / (len(each) - 1))
    name = model.body(body).name or f"body {body}"
    return Fall(name, len(each), *(tuple(v.tolist()) for v in (mean, error, model.opt.gravity)))
