"""How free bodies fall while they touch nothing: there neither contact nor psi has a say.

A clock that runs fast, lengths in another unit or by a camera that is a few per cent out, and another gravity show in
it, and are what contact would be blamed for.
"""

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
LEAST_SAMPLES, LEAST_FLIGHTS = 8, 5
CHANCE, LARGE = 1e-4, 0.01  # of a component by luck, and share of gravity: where flights are not what gravity makes


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
        return bool(((apart > surely * np.array(self.error)) & (apart > LARGE * np.linalg.norm(self.believed))).any())

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

    None where something else than gravity acts in flight by the model itself, or where a position is not recorded.
    """
    model, study = problem.simulator.model, problem.simulator.study
    bodies = [int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == FREE]
    if not bodies or _acted_on(model) or "opt" in _set_otherwise(study):
        return ()
    found: dict[int, list[tuple[float, np.ndarray]]] = {body: [] for body in bodies}
    near = _wider(model, CLEAR * _noise(problem))
    for recording in (*study.recordings, *study.holdout):
        qpos = _positions(model, recording)
        flying = np.zeros(len(qpos), bool)
        there = np.isfinite(qpos).all(1)
        flying[there] = ~contacts.touching(near, qpos[there])[1].any(1)
        for stretch in _stretches(flying):
            places = _centres(model, qpos[stretch], bodies)
            for body, place in zip(bodies, np.swapaxes(places, 0, 1), strict=True):
                found[body].append(_acceleration(recording.time[stretch], place))
    return tuple(_fall(model, body, each) for body, each in found.items() if len(each) >= LEAST_FLIGHTS)


def _acted_on(model: mujoco.MjModel) -> bool:
    """Whether more than gravity and contact may act on what a free joint moves."""
    free = np.isin(model.jnt_type[model.dof_jntid], FREE)
    held = (model.dof_damping[free] != 0) | (model.dof_frictionloss[free] != 0)
    more = model.nu, model.neq, model.ntendon, model.nflex, model.opt.density, model.opt.viscosity
    return any(more) or bool(held.any() or model.body_gravcomp.any())


def _set_otherwise(study: "Study") -> set[str]:
    """Kinds of what psi, or what is known of a recording, sets in the model."""
    known = (target for table in study.known.values() for target in table)
    return {p.target.kind for p in study.parameters} | {target.kind for target in known}


def _noise(problem: "Problem") -> float:
    """The largest noise of a free body's place, m."""
    model, places = problem.simulator.model, state_columns(problem.simulator.model, problem.segments.columns)
    first = model.jnt_qposadr[model.jnt_type == FREE]
    return max(float(problem.noise[j]) for (s, k), j in places.items() if s == "qpos" and 0 <= (k - first).min() < 3)


def _wider(model: mujoco.MjModel, clearance: float) -> mujoco.MjModel:
    """The model with geoms that touch from so far away on."""
    near = copy(model)
    near.geom_margin[:] += 0.5 * clearance
    near.pair_margin[:] += clearance
    return near


def _positions(model: mujoco.MjModel, recording: "Recording") -> Float[np.ndarray, "samples nq"]:
    """NaN where one was not recorded."""
    qpos = np.full((len(recording.time), model.nq), np.nan)
    for (source, k), j in state_columns(model, recording.columns).items():
        if source == "qpos":
            qpos[:, k] = recording.values[:, j]
    return qpos


def _stretches(flying: Bool[np.ndarray, " samples"]) -> list[slice]:
    """Samples of each flight that are APART from what touches before and after it."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flying, [False]]).astype(int)))
    out = []
    for begin, end in edges.reshape(-1, 2):
        first, last = begin + APART * (begin > 0), end - APART * (end < len(flying))
        out += [slice(int(first), int(last))] if last - first >= LEAST_SAMPLES else []
    return out


def _centres(
    model: mujoco.MjModel, qpos: Float[np.ndarray, "samples nq"], bodies: list[int]
) -> Float[np.ndarray, "samples bodies 3"]:
    """Centres of mass of bodies with all that hangs on them."""
    data, out = mujoco.MjData(model), np.zeros((len(qpos), len(bodies), 3))
    for k, state in enumerate(qpos):
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        out[k] = data.subtree_com[bodies]
    return out


def _acceleration(
    time: Float[np.ndarray, " samples"], place: Float[np.ndarray, "samples 3"]
) -> tuple[float, Float[np.ndarray, "3"]]:
    """What a parabola's acceleration counts beside others', and that acceleration."""
    t = time - time.mean()
    parabola = np.linalg.lstsq(np.stack([np.ones_like(t), t, 0.5 * t**2], 1), place, rcond=None)[0]
    return len(t) * float(np.ptp(t)) ** 4, parabola[2]


def _fall(model: mujoco.MjModel, body: int, each: list[tuple[float, np.ndarray]]) -> Fall:
    weight = np.array([w for w, _ in each])[:, None] / sum(w for w, _ in each)
    rates = np.stack([a for _, a in each])
    mean = (weight * rates).sum(0)
    error = np.sqrt((weight**2 * (rates - mean) ** 2).sum(0) * len(each) / (len(each) - 1))
    name = model.body(body).name or f"body {body}"
    return Fall(name, len(each), *(tuple(v.tolist()) for v in (mean, error, model.opt.gravity)))
