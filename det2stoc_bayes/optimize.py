"""Gauss-Newton over the unknowns and the latent starts of several hypotheses at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.engines.layout import position_difference
from det2stoc_bayes.likelihood import LatentStarts, factorize, log_peak
from det2stoc_bayes.problem import Problem, merge_requests, repeat_start
from det2stoc_bayes.start_search import search_starts

UNKNOWN_STEP = 1e-3  # of a prior sd: finite difference in an unknown
START_STEP = 1e-4  # of a coordinate's spread: finite difference in an initial state
FRACTIONS = (0.4, 0.1, 0.02)  # of a step that overshoots
SETTLED = 0.03  # of the tolerance: a step that promises less is not taken
LARGEST_STEP = 3.0  # prior sds in one iteration


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

    @property
    def degrees_of_freedom(self) -> int:
        """Recorded values less those that the initial states use up."""
        return max(self.latent.num_observed - self.problem.segments.count * self.latent.prior_sd.shape[1], 1)

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


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at its most probable point."""

    linear: Linearization
    covariance: Float[np.ndarray, "size size"]  # of z, with the noise scale applied
    noise_scale: float  # variance ratio s2 >= 1 under which the covariance holds
    chi2: float  # whitened squared residual, initial states integrated out
    log_likelihood: float  # at s2 = 1
    converged: bool

    @property
    def problem(self) -> Problem:
        """The hypothesis."""
        return self.linear.problem

    @property
    def point(self) -> Point:
        """Most probable unknowns and initial states."""
        return self.linear.point

    @property
    def noise_inflation(self) -> float:
        """Whitened squared residual over its degrees of freedom: 1 under the right model."""
        free = max(self.linear.degrees_of_freedom - self.problem.size, 1)
        return self.chi2 / self.problem.measurement.mean_square / free


def start_point(problem: Problem, z: Float[np.ndarray, " size"] | None = None) -> Point:
    """The prior's median and the recorded starts, or the likeliest where some position was not recorded."""
    z = np.zeros(problem.size) if z is None else np.asarray(z, float)
    return Point(z, search_starts(problem, z, _linearize_starts))


def _linearize_starts(points: Sequence[tuple[Problem, np.ndarray, Start]]) -> "list[Linearization | None]":
    return linearize([(problem, Point(z, start)) for problem, z, start in points], unknowns=False)


def linearize(points: Sequence[tuple[Problem, Point]], *, unknowns: bool = True) -> list[Linearization | None]:
    """Predictions and finite-difference sensitivities of every hypothesis in one batch; None where they diverge.

    Without `unknowns` only the sensitivities to the initial states are computed, and the others are left empty.
    """
    requests = []
    for problem, point in points:
        states = problem.guess.scale.shape[0]
        variants = 1 + states + (problem.size if unknowns else 0)
        start = repeat_start(point.start, variants)
        change = np.zeros((variants, problem.segments.count, states))
        change[1 + np.arange(states), :, np.arange(states)] = (START_STEP * problem.guess.scale)[:, None]
        z = np.tile(point.z, (variants, 1))
        if unknowns:
            z[1 + states + np.arange(problem.size), np.arange(problem.size)] += UNKNOWN_STEP
        moved = problem.moved(start, change.reshape(-1, states))
        requests.append(problem.request(z, moved))
    predicted = _simulate(points, requests)
    return [_assemble(problem, point, p) for (problem, point), p in zip(points, predicted, strict=True)]


def _simulate(points, requests) -> list[np.ndarray]:
    merged = merge_requests(requests)
    predicted = points[0][0].simulator.rollout(merged)
    return np.split(predicted, np.cumsum([len(r.which) for r in requests])[:-1])


def _assemble(problem: Problem, point: Point, predicted: np.ndarray) -> Linearization | None:
    states, count = problem.guess.scale.shape[0], problem.segments.count
    base = predicted[:count]
    if not np.isfinite(base).all():
        return None
    r = problem.residuals(predicted).reshape(-1, count, problem.weight.shape[1])
    change = np.nan_to_num(r[0] - r[1:])  # a perturbation that diverges tells nothing
    a = np.moveaxis(change[:states], 0, -1) / (START_STEP * problem.guess.scale)
    j = np.moveaxis(change[states:], 0, -1) / UNKNOWN_STEP
    error, measurement = r[0] * problem.weight, problem.measurement
    peak = log_peak(problem.weight, measurement)
    latent = factorize(a, problem.weight * measurement.slope(error), problem.guess.prior_sd, peak)
    stacked = latent.stack_whitened(measurement.bend(error)[..., None], _tangent(problem, point.start)[..., None])
    return Linearization(problem, point, latent, stacked, latent.stack(j))


def _tangent(problem: Problem, start: Start) -> Float[np.ndarray, "segments states"]:
    """How far the guessed starts lie from these, in tangent coordinates."""
    guess = problem.guess.start
    apart = position_difference(problem.simulator.model, start.qpos, guess.qpos)
    return np.concatenate([apart, guess.qvel - start.qvel], 1)


def fit_many(
    points: Sequence[tuple[Problem, Point]],
    *,
    max_iterations: int = 8,
    tolerance: float = 0.05,
    free_scale: bool = True,
) -> list[Fit | None]:
    """Most probable unknowns of every hypothesis; None where its simulations diverge from the start.

    `tolerance` is the expected gain in nats at which an iteration is the last. With `free_scale` a misfit beyond the
    noise widens the noise (s2 >= 1), so that the prior is not swamped by model error.
    """
    linear = {i: lin for i, lin in enumerate(linearize(points)) if lin is not None}
    done = dict.fromkeys(linear, False)
    for _ in range(max_iterations):
        todo = [i for i, over in done.items() if not over]
        if not todo:
            break
        steps = {i: _newton_step(linear[i], free_scale) for i in todo}
        for i in todo:
            done[i] = not steps[i].gain > SETTLED * tolerance  # NaN included
        trials = {i: _moved(linear[i], steps[i], 1.0) for i in todo if not done[i]}
        for i, lin in _improved(linear, steps, trials, tolerance).items():
            done[i] = lin is None or steps[i].gain < tolerance
            linear[i] = linear[i] if lin is None else lin
    return [summarize(linear[i], free_scale, done[i]) if i in linear else None for i in range(len(points))]


@dataclass(frozen=True)
class _Step:
    z: Float[np.ndarray, " size"]
    gain: float  # expected, nats
    s2: float


def _improved(linear, steps, trials, tolerance) -> dict[int, Linearization | None]:
    """Linearizations at the moved points; where a full step is no improvement, at the best fraction of it."""
    if not trials:
        return {}
    full = dict(zip(trials, linearize([(linear[i].problem, p) for i, p in trials.items()]), strict=True))
    worse = [i for i, lin in full.items() if lin is None or _height(lin, steps[i].s2) > _height(linear[i], steps[i].s2)]
    full |= dict.fromkeys(worse)
    search = [i for i in worse if steps[i].gain >= tolerance]
    if not search:
        return full
    found = _line_search([linear[i] for i in search], [steps[i] for i in search])
    better = {i: p for i, p in zip(search, found, strict=True) if p is not None}
    again = linearize([(linear[i].problem, p) for i, p in better.items()]) if better else []
    return full | dict(zip(better, again, strict=True))


def fit_starts(problem: Problem, z: Float[np.ndarray, " size"], *, num_iterations: int = 4) -> Linearization | None:
    """The most probable initial states under fixed unknowns; None where the simulation diverges."""
    point = start_point(problem, z)
    lin = linearize([(problem, point)], unknowns=False)[0]
    for _ in range(num_iterations):
        if lin is None:
            return None
        moved = Point(point.z, problem.moved(lin.point.start, lin.latent.best_start(lin.stacked)))
        after = linearize([(problem, moved)], unknowns=False)[0]
        if after is None or _height(after, 1.0) >= _height(lin, 1.0) - 1e-3:
            return lin
        lin = after
    return lin


def _height(lin: Linearization, s2: float) -> float:
    return float((lin.stacked**2).sum()) / s2 + float(lin.point.z @ lin.point.z)


def _moved(lin: Linearization, step: _Step, fraction: float) -> Point:
    change = lin.latent.best_start(lin.stacked - fraction * (lin.columns @ step.z)[..., None])
    return Point(lin.point.z + fraction * step.z, lin.problem.moved(lin.point.start, change))


def noise_scale(lin: Linearization, chi2: float, free_scale: bool) -> float:
    """Variance ratio by which the misfit exceeds the noise, at least 1."""
    dof = max(lin.degrees_of_freedom - lin.problem.size, 1)
    return max(1.0, chi2 / lin.problem.measurement.mean_square / dof) if free_scale else 1.0


def _newton_step(lin: Linearization, free_scale: bool) -> _Step:
    gram, slope, square = (x.sum(0) for x in lin.gram())
    s2 = noise_scale(lin, float(square), free_scale)
    precision = gram / s2 + np.eye(lin.problem.size)
    gradient = slope / s2 - lin.point.z
    z = np.linalg.solve(precision, gradient) if lin.problem.size else np.zeros(0)
    z *= min(1.0, LARGEST_STEP / max(np.abs(z).max(initial=0.0), 1e-12))
    r = lin.latent.project(lin.stacked)
    free = float((lin.stacked**2).sum() - (r**2).sum())
    return _Step(z, 0.5 * float(gradient @ z) + 0.5 * free / s2, s2)


def _line_search(linear: Sequence[Linearization], steps: Sequence[_Step]) -> list[Point | None]:
    """The best of several fractions of each step by simulation; None where none is an improvement."""
    tried, requests = [], []
    for lin, step in zip(linear, steps, strict=True):
        # Starts alone come last: when the step itself is bad, the starts can still be improved.
        alone = Point(lin.point.z, lin.problem.moved(lin.point.start, lin.latent.best_start(lin.stacked)))
        points = [*(_moved(lin, step, fraction) for fraction in FRACTIONS), alone]
        tried.append(points)
        start = Start(*(np.concatenate([getattr(p.start, a) for p in points]) for a in ("qpos", "qvel", "act")))
        requests.append(lin.problem.request(np.stack([p.z for p in points]), start))
    predicted = _simulate([(lin.problem, lin.point) for lin in linear], requests)
    best = []
    for lin, step, points, p in zip(linear, steps, tried, predicted, strict=True):
        objective = _objective(lin, points, p, step.s2)
        i = int(np.argmin(objective))
        best.append(points[i] if objective[i] < _height(lin, step.s2) else None)
    return best


def _objective(lin: Linearization, points: Sequence[Point], predicted: np.ndarray, s2: float) -> np.ndarray:
    r = lin.problem.residuals(predicted).reshape(len(points), lin.problem.segments.count, -1)
    misfit = (lin.problem.measurement.bend(r * lin.problem.weight) ** 2).sum((1, 2))
    below = [((_tangent(lin.problem, p.start) / lin.problem.guess.prior_sd) ** 2).sum() for p in points]
    total = (misfit + np.array(below)) / s2 + np.array([p.z @ p.z for p in points])
    finite = np.isfinite(predicted).all((1, 2)).reshape(len(points), -1).all(1)
    return np.where(finite, total, np.inf)


def summarize(lin: Linearization, free_scale: bool, converged: bool) -> Fit:
    """Chi2, likelihood and the covariance of z at a point."""
    gram, _, square = (x.sum(0) for x in lin.gram())
    chi2 = float(square)
    s2 = noise_scale(lin, chi2, free_scale)
    covariance = np.linalg.inv(gram / s2 + np.eye(lin.problem.size))
    return Fit(lin, covariance, s2, chi2, lin.latent.log_normalizer - 0.5 * chi2, converged)
