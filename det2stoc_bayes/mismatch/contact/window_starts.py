"""Initial states of windows from their first samples, by a statistical linearization over the measurement noise.

The recorded first sample has the measurement's noise: a box that is seen half a millimetre deep in the floor is thrown
out of it. Predictions from states one noise sd to either side say, without a derivative, how the next samples correct
the first one (the unscented smoother of Sarkka, 2008, with points one sd away); a window where that is no improvement
keeps what was recorded.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.engines.layout import position_difference
from det2stoc_bayes.engines.state_columns import quaternion_address, state_columns
from det2stoc_bayes.mismatch.contact.scales import DEGREES
from det2stoc_bayes.mismatch.contact.windows import Windows
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.starts import guess_starts

LOOKED_AT = 6  # samples from the start on
RATE = 0.5  # noise sds over a sampling interval: sd of a speed that is estimated from positions
UNSEEN = 0.3  # spreads of what no column shows
ROUNDS = 4
SHORTER = (1.0, 0.4, 0.1)  # of a correction


def smoothed(windows: Windows, z: Float[np.ndarray, " size"]) -> Windows:
    """The same windows with starts that the samples after them have corrected, under these unknowns."""
    windows = as_recorded(windows)
    problem = windows.problem
    n = min(LOOKED_AT, problem.segments.time.shape[1])
    whole = problem.segments
    short = replace(problem, segments=replace(whole, time=whole.time[:, :n], values=whole.values[:, :n]))
    sd, first, start = start_sd(problem), problem.guess.start, problem.guess.start
    height = None
    for _ in range(ROUNDS):
        start, height = _corrected(short, z, first, start, sd, height)
    return windows.starting(start)


def as_recorded(windows: Windows) -> Windows:
    """The same windows with starts that no hypothesis has a part in."""
    return windows.starting(recorded_start(windows.problem))


def away(windows: Windows) -> Float[np.ndarray, "windows states"]:
    """Each window's start less the recorded one, in sds of the latter."""
    problem = windows.problem
    return -_tangent(problem, problem.guess.start, recorded_start(problem)) / start_sd(problem)


def recorded_start(problem: Problem) -> Start:
    """What was recorded at each window's start, rates of positions where speeds were not."""

    return guess_starts(problem.simulator.model, problem.segments).start


def start_sd(problem: Problem) -> Float[np.ndarray, " states"]:
    """sd of recorded starts in tangent coordinates (positions, speeds)."""
    model, noise, nv = problem.simulator.model, problem.noise, problem.simulator.model.nv
    places = state_columns(model, problem.segments.columns)
    intervals = np.diff(problem.segments.time, axis=1)
    dt = float(np.median(intervals[intervals > 0]))
    sd = UNSEEN * problem.guess.scale.copy()
    for joint in range(model.njnt):
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        turn = quaternion_address(model, joint)
        straight = 1 if turn is None else turn - q
        for k in range(straight):
            if ("qpos", q + k) in places:
                sd[v + k] = noise[places["qpos", q + k]]
                sd[nv + v + k] = min(RATE * sd[v + k] / dt, sd[nv + v + k])
        if turn is not None and all(("qpos", turn + k) in places for k in range(4)):
            angle = 2 * float(np.mean([noise[places["qpos", turn + k]] for k in range(4)]))
            sd[v + straight : v + straight + 3] = angle
            low = nv + v + straight
            sd[low : low + 3] = np.minimum(RATE * angle / dt, sd[low : low + 3])
    for dof in range(nv):
        if ("qvel", dof) in places:
            sd[nv + dof] = noise[places["qvel", dof]]
    return sd


def _corrected(
    short: Problem,
    z: np.ndarray,
    first: Start,
    start: Start,
    sd: Float[np.ndarray, " states"],
    height: Float[np.ndarray, " windows"] | None,
) -> tuple[Start, Float[np.ndarray, " windows"]]:
    """One correction of every start, and the misfit of the first samples and of the start where it ends."""
    count, states = short.segments.count, len(sd)
    change = np.zeros((2 * states + 1, count, states))
    for i in range(states):
        change[1 + 2 * i, :, i], change[2 + 2 * i, :, i] = sd[i], -sd[i]
    e = _errors(short, z, start, change)
    way = np.zeros((count, states))
    slope = 0.5 * (e[2::2] - e[1::2])  # of the prediction, for one sd
    finite = np.isfinite(e).all((0, 2))
    x = np.moveaxis(slope[:, finite], 0, -1)
    back = _tangent(short, start, first)[finite] / sd
    weight = (DEGREES + 1) / (DEGREES + e[0][finite] ** 2)
    gram = np.einsum("wn,wnk,wnl->wkl", weight, x, x) + np.eye(states)
    pull = np.einsum("wn,wnk,wn->wk", weight, x, e[0][finite]) + back
    way[finite] = np.linalg.solve(gram, pull[..., None])[..., 0] * sd
    if height is None:
        height = _height(e[0], _tangent(short, start, first) / sd)
    tried = np.stack([share * way for share in SHORTER])
    errors = _errors(short, z, start, tried)
    for one, error in zip(tried, errors, strict=True):
        moved = short.moved(start, one)
        there = _height(error, _tangent(short, moved, first) / sd)
        better = there < height
        start = start.taking(moved, better)
        height = np.where(better, there, height)
    return start, height


def _height(error: np.ndarray, away: np.ndarray) -> Float[np.ndarray, " windows"]:
    with np.errstate(invalid="ignore"):
        told = (DEGREES + 1) * np.log1p(error**2 / DEGREES)
        return np.where(np.isfinite(error).all(1), told.sum(1) + (away**2).sum(1), np.inf)


def _errors(
    short: Problem, z: np.ndarray, start: Start, change: Float[np.ndarray, "variants windows states"]
) -> Float[np.ndarray, "variants windows values"]:
    """Errors in noise sds from starts moved by these changes."""
    n = len(change)
    tiled = Start(*(np.tile(a, (n, 1)) for a in (start.qpos, start.qvel, start.act)))
    moved = short.moved(tiled, change.reshape(-1, change.shape[2]))
    predicted = short.simulator.rollout(short.request(np.tile(z, (n, 1)), moved))
    r = short.residuals(predicted).reshape(n, short.segments.count, -1)
    return r * short.weight


def _tangent(short: Problem, start: Start, first: Start) -> Float[np.ndarray, "windows states"]:
    """How far the recorded starts lie from these."""

    apart = position_difference(short.simulator.model, start.qpos, first.qpos)
    return np.concatenate([apart, first.qvel - start.qvel], 1)
