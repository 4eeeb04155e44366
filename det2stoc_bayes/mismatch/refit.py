"""A fitted hypothesis with an effect less, with another in its place, or in another order."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.race import Ranked, tolerance
from det2stoc_bayes.optimize import Fit, fit_many, summarize


def keep(fit: Fit, effects: Sequence[PlacedEffect]) -> Point:
    """A fit's unknowns without those of dropped effects."""
    blocks, begin = {}, fit.problem.num_psi
    for e in fit.problem.effects:
        blocks[e] = fit.point.z[begin : begin + e.size]
        begin += e.size
    parts = [fit.point.z[: fit.problem.num_psi], *(blocks[e] for e in effects)]
    return Point(np.concatenate(parts), fit.point.start)


def refit(fit: Fit, effects: Sequence[PlacedEffect]) -> Fit | None:
    """The best fit with only some of the effects, on the same segments; None where no simulation follows them."""
    return _refits(fit, [effects])[0]


def without(fit: Fit, i: int) -> Fit | None:
    """The best fit without effect i; None where no simulation follows the recordings."""
    return without_each(fit, [fit.problem.effects[i]])[0]


def without_each(fit: Fit, dropped: Sequence[PlacedEffect]) -> list[Fit | None]:
    """The best fits without each of these effects, the others staying."""
    return _refits(fit, [[e for e in fit.problem.effects if e != gone] for gone in dropped])


def _refits(fit: Fit, choices: Sequence[Sequence[PlacedEffect]]) -> list[Fit | None]:
    points = [(fit.problem.with_effects(effects), keep(fit, effects)) for effects in choices]
    return fit_many(points, tolerance=tolerance(fit)) if points else []


def swap(fit: Fit, i: int, other: Ranked) -> Fit:
    """The best fit with another candidate in place i of the list, from where that was fitted beside the same others."""
    effects = list(fit.problem.effects)
    if effects[i] == other.placed:
        return fit
    here, there = fit.problem.segments, other.fit.problem.segments
    if len(effects) == 1 and posed_alike(fit, other.fit):
        return other.fit
    if here.extent == there.extent and {*effects[:i], other.placed, *effects[i + 1 :]} == {*other.fit.problem.effects}:
        effects[i] = other.placed
        point = keep(other.fit, effects)
        return fit_many([(fit.problem.with_effects(effects), point)], tolerance=tolerance(fit))[0] or fit
    kept = keep(fit, [e for k, e in enumerate(effects) if k != i])
    cut_at = fit.problem.num_psi + sum(e.size for e in effects[:i])
    own = other.fit.point.z[other.fit.problem.size - other.placed.size :]
    effects[i] = other.placed
    z = np.concatenate([kept.z[:cut_at], own, kept.z[cut_at:]])
    found = fit_many([(fit.problem.with_effects(effects), Point(z, fit.point.start))], tolerance=tolerance(fit))[0]
    return fit if found is None else found


def posed_alike(fit: Fit, other: Fit) -> bool:
    """Whether both are of the same stretches, integrated alike."""
    a, b = fit.problem, other.problem
    steps = (a.timestep, a.integrator) == (b.timestep, b.integrator) and a.finer is b.finer
    return steps and a.segments.extent == b.segments.extent


def reordered(fit: Fit, i: int) -> Fit:
    """The same fit with effect i last, as refinement leaves it."""
    effects = list(fit.problem.effects)
    begins = np.cumsum([fit.problem.num_psi, *(e.size for e in effects)])
    own = np.arange(begins[i], begins[i + 1])
    order = np.concatenate([np.setdiff1d(np.arange(fit.problem.size), own), own])
    problem = fit.problem.with_effects([e for k, e in enumerate(effects) if k != i] + [effects[i]])
    lin = fit.linear
    point = Point(lin.point.z[order], lin.point.start)
    moved = replace(lin, problem=problem, point=point, columns=lin.columns[..., order])
    return summarize(moved, True, fit.end)
