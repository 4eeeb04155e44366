"""Predictions about a point: what each unknown and each latent start would change, by finite differences."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.engines.layout import position_difference
from det2stoc_bayes.likelihood import LatentStarts, factorize, log_peak
from det2stoc_bayes.problem import Problem, merge_requests, repeat_start
from det2stoc_bayes.start_search import search_starts
from det2stoc_bayes.unknowns import Unknowns

UNKNOWN_STEP = 1e-5  # of a prior sd: at 1e-3 the second order stiffens flat valleys, at 1e-7 rounding shows
START_STEP = 1e-4  # of a coordinate's spread: finite difference in an initial state


@dataclass(frozen=True, eq=False)
class Point:
    """Where a hypothesis stands: unknowns and initial states."""

    z: Float[np.ndarray, " size"]
    start: Start


@dataclass(frozen=True, eq=False)
class Linearization:
    """Prediction error at a point and what it would take to change it."""

    problem: Problem
    point: Point
    latent: LatentStarts
    stacked: Float[np.ndarray, "segments stacked 1"]  # whitened residual over the start prior's
    columns: Float[np.ndarray, "segments stacked size"]  # its sensitivity to the unknowns (sign: of the prediction)
    exact: bool = True  # whether the sensitivities were taken at this very point

    @property
    def degrees_of_freedom(self) -> int:
        """Recorded values less those that the initial states use up."""
        return self.latent.degrees_of_freedom

    def about(self, point: Point, predicted: np.ndarray) -> "Linearization | None":
        """The same sensitivities to psi about another point, whose prediction is known; None where it diverged."""
        if not np.isfinite(predicted).all():
            return None
        problem = self.problem
        error = problem.residuals(predicted) * problem.weight
        stacked = self.latent.stack_whitened(
            problem.measurement.bend(error)[..., None], tangent(problem, point.start)[..., None]
        )
        then, now = problem.slopes(self.point.z), problem.slopes(point.z)
        ratio = np.divide(now, then, out=np.ones(problem.size), where=then > 0)
        return replace(self, point=point, stacked=stacked, columns=self.columns * ratio, exact=False)

    def gram(
        self,
    ) -> tuple[
        Float[np.ndarray, "segments size size"],
        Float[np.ndarray, "segments size"],
        Float[np.ndarray, " segments"],
    ]:
        """Per segment J'J, J'r and r'r after the initial states are integrated out."""
        j, r = self.latent.project(self.columns), self.latent.project(self.stacked)[..., 0]
        return np.swapaxes(j, 1, 2) @ j, np.einsum("snk,sn->sk", j, r), (r**2).sum(1)


def start_point(
    problem: Problem,
    z: Float[np.ndarray, " size"] | None = None,
    shorter: Linearization | None = None,
    seed: int = 0,
) -> Point:
    """The prior's median and the recorded starts, or the likeliest where some position was not recorded.

    `shorter` is the same hypothesis on shorter stretches, whose starts are tried too; with another `seed` others are.
    """
    z = np.zeros(problem.size) if z is None else np.asarray(z, float)
    return Point(z, search_starts(problem, z, _linearize_starts, shorter, seed))


def _linearize_starts(points: Sequence[tuple[Problem, np.ndarray, Start]]) -> "list[Linearization | None]":
    return linearize([(problem, Point(z, start)) for problem, z, start in points], unknowns="own")


def linearize(
    points: Sequence[tuple[Problem, Point]], *, unknowns: Literal["all", "own"] = "all"
) -> list[Linearization | None]:
    """Predictions and finite-difference sensitivities of every hypothesis in one batch; None where they diverge.

    With "own" only what belongs to single recordings (starts, values of a psi that varies) is moved; the columns of
    the other unknowns are zero.
    """
    requests, moves = [], []
    for problem, point in points:
        states, followed = problem.guess.scale.shape[0], problem.unknowns.followed(point.z)
        probes = [which for which in problem.probes(unknowns) if which[0] not in followed]
        moves.append([(moved, problem.nudge(point.z, moved, UNKNOWN_STEP)) for moved in probes])
        variants = 1 + states + len(probes)
        start = repeat_start(point.start, variants)
        change = np.zeros((variants, problem.segments.count, states))
        change[1 + np.arange(states), :, np.arange(states)] = (START_STEP * problem.guess.scale)[:, None]
        z = np.tile(point.z, (variants, 1))
        for k, (moved, step) in enumerate(moves[-1]):
            z[1 + states + k, moved] += step
        requests.append(problem.request(z, problem.moved(start, change.reshape(-1, states))))
    predicted = simulate(points, requests)
    return [
        _assemble(problem, point, p, m, shared=unknowns == "all")
        for (problem, point), p, m in zip(points, predicted, moves, strict=True)
    ]


def linearize_beside(base: Linearization, points: Sequence[tuple[Problem, Point]]) -> list[Linearization | None]:
    """The same hypothesis with effects added, roughly: only the effects' own unknowns are moved.

    Sensitivities to the others and to the starts are those of `base`.
    """
    requests, moves = [], []
    for problem, point in points:
        added = [np.array([i]) for i in range(base.problem.size, problem.size)]
        moves.append([(moved, problem.nudge(point.z, moved, UNKNOWN_STEP)) for moved in added])
        z = np.tile(point.z, (1 + len(added), 1))
        for k, (moved, step) in enumerate(moves[-1]):
            z[1 + k, moved] += step
        requests.append(problem.request(z, repeat_start(point.start, 1 + len(added))))
    out, count = [], base.problem.segments.count
    for (problem, point), predicted, own in zip(points, simulate(points, requests), moves, strict=True):
        r = problem.residuals(predicted).reshape(-1, count, problem.weight.shape[1])
        columns = np.zeros((*r.shape[1:], problem.size))
        for (moved, step), column in zip(own, np.nan_to_num(r[0] - r[1:]), strict=True):
            columns[..., moved[0]] = column / step
        stacked = base.latent.stack(columns)
        stacked[..., : base.problem.size] = base.columns
        z = np.concatenate([base.point.z, point.z[base.problem.size :]])
        there = replace(base, problem=problem, point=Point(z, base.point.start), columns=stacked)
        out.append(there.about(point, predicted[:count]))
    return out


def simulate(points, requests) -> list[np.ndarray]:
    merged = merge_requests(requests)
    predicted = points[0][0].simulator.rollout(merged)
    return np.split(predicted, np.cumsum([len(r.which) for r in requests])[:-1])


def _assemble(
    problem: Problem,
    point: Point,
    predicted: np.ndarray,
    moves: Sequence[tuple[np.ndarray, float]],
    *,
    shared: bool,
) -> Linearization | None:
    states, count = problem.guess.scale.shape[0], problem.segments.count
    base = predicted[:count]
    if not np.isfinite(base).all():
        return None
    r = problem.residuals(predicted).reshape(-1, count, problem.weight.shape[1])
    change = np.nan_to_num(r[0] - r[1:])  # a perturbation that diverges tells nothing
    a = np.moveaxis(change[:states], 0, -1) / (START_STEP * problem.guess.scale)
    j = np.zeros((*change.shape[1:], problem.size))
    straight = problem.straightener(point.z)
    for (moved, step), column in zip(moves, change[states:], strict=True):
        there = np.array(point.z)
        there[moved] += step
        column = column / straight(there)[moved[0]]
        if len(moved) == 1:
            j[..., moved[0]] = column
            continue
        for k, i in enumerate(moved):
            mine = problem.segments.recording == k
            j[mine, :, i] = column[mine]
    if shared:
        follow_own(problem.unknowns, point.z, j, problem.segments.recording)
    error, measurement = r[0] * problem.weight, problem.measurement
    peak = log_peak(problem.weight, measurement)
    latent = factorize(a, problem.weight * measurement.slope(error), problem.guess.prior_sd, peak)
    stacked = latent.stack_whitened(measurement.bend(error)[..., None], tangent(problem, point.start)[..., None])
    return Linearization(problem, point, latent, stacked, latent.stack(j))


def follow_own(
    unknowns: Unknowns,
    z: Float[np.ndarray, " size"],
    columns: Float[np.ndarray, "rows *values size"],
    recording: Int[np.ndarray, " rows"],
) -> None:
    """Sensitivities to what recordings share of a psi that varies, from those to their own values.

    Finite differences of both would differ by more than the recordings tell: mu and the own values would hold each
    other where they are, although a prediction sees only their sum.
    """
    rows = np.arange(len(columns))
    for block in unknowns.varying:
        own = columns[rows, ..., block.first_own + recording]
        for i, slope in enumerate(block.shared_slopes(z), block.begin):
            if np.isfinite(slope).all():
                columns[..., i] = own * slope[recording].reshape(-1, *(1,) * (own.ndim - 1))


def tangent(problem: Problem, start: Start) -> Float[np.ndarray, "segments states"]:
    """How far the guessed starts lie from these, in tangent coordinates."""
    guess = problem.guess.start
    apart = position_difference(problem.simulator.model, start.qpos, guess.qpos)
    return np.concatenate([apart, guess.qvel - start.qvel], 1)
