"""What belongs to single recordings, fitted to each of them while the other unknowns stay as they are."""

from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.linearization import Linearization, Point, linearize, start_point
from det2stoc_bayes.mismatch.evidence import by_chance
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.problem import Problem

NUM_STEPS = 6
LEAST_GAIN = 1e-2  # of whitened squared residual: what promises less is not moved
SHORTER = 0.3  # of a step that is no improvement
MOST_SEARCHES = 6  # with other starts each
MOST_VAIN = 2  # searches that better no segment: then no more are made
WORSE, ENOUGH = 3.0, 4  # times the misfit of the better quarter of segments, if these are so many, to be searched again
VALLEY = 0.5  # of the misfit: what another start leaves more of is in no better valley
LARGEST_STEP = 10.0  # prior sds of a psi that varies, in one step


def fit_starts(problem: Problem, z: Float[np.ndarray, " size"]) -> Linearization | None:
    """The most probable initial states, and values of psi by recording, under the other unknowns as they are.

    Recordings are simulated together but step by themselves. None where the simulation of one diverges.
    """
    lin = linearize([(problem, start_point(problem, z))], unknowns="own")[0]
    share = np.ones(len(problem.segments.recordings))
    for _ in range(NUM_STEPS):
        if lin is None:
            return None
        step = _own_step(lin)
        moving = np.where(_heights(lin) - _promised(lin, step) > LEAST_GAIN, share, 0.0)
        if not moving.any():
            return lin
        after = linearize([(problem, _moved(lin, step, moving))], unknowns="own")[0]
        better = np.zeros(len(share), bool) if after is None else _heights(after) < _heights(lin)
        share = np.where(better, 1.0, SHORTER * share)
        lin = lin if after is None else _mixed(lin, after, better)
    return lin


def searched_again(fit: Fit, **options: Any) -> Fit:
    """With starts that were not recorded searched anew, under the psi that was fitted, where a segment is told ill.

    The fit itself where it leaves only chance, or where that does not better it; `options` are `fit_many`'s.
    """
    problem, moved, vain = fit.problem, False, 0
    if by_chance(fit) or problem.guess.seen.all():
        return fit
    start = deepcopy(fit.point.start)
    height = (fit.linear.stacked**2).sum((1, 2))
    for seed in range(1, 1 + MOST_SEARCHES):
        rows = _astray(problem, height)
        if not len(rows) or vain == MOST_VAIN:
            break
        some = problem.only(rows)
        point = start_point(some, fit.point.z, fit.linear, seed)
        lin = linearize([(some, point)], unknowns="own")[0]
        found = np.full(len(rows), np.inf) if lin is None else (lin.stacked**2).sum((1, 2))
        better = found < VALLEY * height[rows]
        there = rows[better]
        height[there] = found[better]
        start.qpos[there], start.qvel[there] = point.start.qpos[better], point.start.qvel[better]
        moved, vain = moved or len(there) > 0, vain + (len(there) == 0)
    again = fit_many([(problem, Point(fit.point.z, start))], **options)[0] if moved else None
    return fit if again is None or again.noise_inflation > fit.noise_inflation else again


def _astray(problem: Problem, height: Float[np.ndarray, " segments"]) -> Int[np.ndarray, " rows"]:
    """Segments told much worse than the better ones (of few: than by chance), as from starts in another valley."""
    values = problem.segments.observed.sum((1, 2))
    each = height / np.maximum(values, 1) / problem.measurement.mean_square
    told = each[values > 0]
    usual = float(np.quantile(told, 0.25, method="lower")) if len(told) >= ENOUGH else 1.0
    return np.flatnonzero((values > 0) & (each > WORSE * max(usual, 1.0)))


def _own_step(lin: Linearization) -> Float[np.ndarray, " size"]:
    """Newton's step in the values of psi by recording alone."""
    own, step = lin.problem.unknowns.owned, np.zeros(lin.problem.size)
    if len(own):
        gram, slope, _ = (x.sum(0) for x in lin.gram())
        precision = gram[np.ix_(own, own)] + np.eye(len(own))
        step[own] = np.clip(np.linalg.solve(precision, slope[own] - lin.point.z[own]), -LARGEST_STEP, LARGEST_STEP)
    return step


def _by_recording(lin: Linearization, by_segment: np.ndarray, z: np.ndarray) -> Float[np.ndarray, " recordings"]:
    """Squares of segments, and of the recordings' own unknowns, summed over each recording."""
    out = np.bincount(lin.problem.segments.recording, by_segment, len(lin.problem.segments.recordings))
    for rows in lin.problem.unknowns.own:
        out += z[rows] ** 2
    return out


def _heights(lin: Linearization) -> Float[np.ndarray, " recordings"]:
    return _by_recording(lin, (lin.stacked**2).sum((1, 2)), lin.point.z)


def _promised(lin: Linearization, step: np.ndarray) -> Float[np.ndarray, " recordings"]:
    """Heights after a whole step, were predictions linear."""
    left = lin.latent.project(lin.stacked - (lin.columns @ step)[..., None])
    return _by_recording(lin, (left**2).sum((1, 2)), lin.point.z + step)


def _moved(lin: Linearization, step: np.ndarray, share: Float[np.ndarray, " recordings"]) -> Point:
    problem, z = lin.problem, lin.point.z.copy()
    for rows in problem.unknowns.own:
        z[rows] += share * step[rows]
    seen = lin.columns @ (z - lin.point.z)
    change = lin.latent.best_start(lin.stacked - seen[..., None]) * share[problem.segments.recording][:, None]
    return Point(z, problem.moved(lin.point.start, change))


def _mixed(before: Linearization, after: Linearization, better: Bool[np.ndarray, " recordings"]) -> Linearization:
    """Each recording as it was or as it is after a step."""
    segments, z = better[before.problem.segments.recording], before.point.z.copy()
    for rows in before.problem.unknowns.own:
        z[rows] = np.where(better, after.point.z[rows], z[rows])

    def pick(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.where(segments.reshape(-1, *[1] * (a.ndim - 1)), b, a)

    old, new = before.latent, after.latent
    latent = replace(old, **{n: pick(a, getattr(new, n)) for n, a in vars(old).items() if a is not None})
    starts = [pick(getattr(before.point.start, n), getattr(after.point.start, n)) for n in ("qpos", "qvel", "act")]
    stacked, columns = pick(before.stacked, after.stacked), pick(before.columns, after.columns)
    return replace(before, point=Point(z, Start(*starts)), latent=latent, stacked=stacked, columns=columns)
