"""How well recordings that were not fitted are predicted, before and after."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.linearization import Linearization
from det2stoc_bayes.optimize import Fit, fit_starts
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import cut

WARM_UP = 0.1  # of a stretch: the samples from which its initial state is estimated
LEAST_WARM_UP = 10  # samples
NEGLIGIBLE = 0.05  # of the held-out squared error beyond noise
CHANCE = 3.0  # standard deviations of chi2 by which the held-out error exceeds noise by chance
DIVERGED = 1e6  # whitened squared error a value at which a diverged rollout is counted


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Scores of one hypothesis, one entry a held-out recording, and the rollouts behind them."""

    names: tuple[str, ...]
    log_density: Float[np.ndarray, " recordings"]
    chi2: Float[np.ndarray, " recordings"]  # whitened squared error, initial states integrated out
    num_values: Float[np.ndarray, " recordings"]
    squared_error: Float[np.ndarray, "recordings columns"]  # of rollouts beyond their warm-up
    num_errors: Float[np.ndarray, "recordings columns"]
    rollouts: dict[str, Float[np.ndarray, "samples columns"]]  # NaN where a rollout diverged

    @property
    def rmse(self) -> Float[np.ndarray, " columns"]:
        """Root mean square error of each column over all rollouts."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.squared_error.sum(0) / self.num_errors.sum(0))


def horizon_samples(fit: Fit) -> int | None:
    """Samples of a rollout: those of the fit's own stretches; None for whole recordings."""
    segments = fit.problem.segments
    if segments.count == len(segments.recordings):
        return None
    return int(np.median(segments.lengths))


def evaluate(fit: Fit, z_by_recording: dict[str, np.ndarray], recordings: tuple[Recording, ...]) -> HeldOut:
    """Scores of recordings under the unknowns given for each of them."""
    scores = [_one(fit, z_by_recording[r.name], r) for r in recordings]
    names = tuple(r.name for r in recordings)
    density, chi2, values, error, count, paths = zip(*scores, strict=True)
    return HeldOut(
        names,
        np.array(density),
        np.array(chi2),
        np.array(values),
        np.array(error),
        np.array(count),
        dict(zip(names, paths, strict=True)),
    )


def misfit(fit: Fit, z: np.ndarray, recording: Recording) -> float:
    """Whitened squared error of one recording, initial states integrated out."""
    problem, z = _posed(fit, z, recording)
    lin = fit_starts(problem, z)
    return DIVERGED * float(problem.segments.observed.sum()) if lin is None else own_integrated(lin)[0]


def _posed(fit: Fit, z: np.ndarray, recording: Recording) -> tuple[Problem, np.ndarray]:
    """The same hypothesis on one recording, at the fit's horizon."""
    problem = fit.problem.on(cut((recording,), horizon_samples(fit), fit.problem.segments.columns))
    return problem, fit.problem.carry(z, problem)


def _one(fit: Fit, z: np.ndarray, recording: Recording):
    """Log density, chi2 and its count, squared rollout errors and their counts, rollout of one recording."""
    problem, z = _posed(fit, z, recording)
    segments, lin = problem.segments, fit_starts(problem, z)
    width = len(segments.columns)
    if lin is None:
        nothing, values = np.full((len(recording.time), width), np.nan), float(segments.observed.sum())
        chi2 = DIVERGED * values
        return -0.5 * chi2, chi2, values, np.full(width, np.inf), np.ones(width), nothing
    chi2, normalizer = own_integrated(lin)
    predicted = _rollout(problem, z)
    error = problem.residuals(predicted).reshape(segments.values.shape)
    counted = segments.observed.copy()
    for s in range(segments.count):
        counted[s, : _warm(int(segments.lengths[s]))] = False
    error = np.where(counted, error, 0.0)
    path = np.concatenate([p[:n] for p, n in zip(predicted, segments.lengths, strict=True)])
    return (
        normalizer - 0.5 * chi2,
        chi2 / problem.measurement.mean_square,
        float(lin.degrees_of_freedom),
        (error**2).sum((0, 1)),
        counted.sum((0, 1)).astype(float),
        path,
    )


def own_integrated(lin: Linearization) -> tuple[float, float]:
    """chi2 and log normalizer with starts and values of psi by recording integrated out."""
    gram, _, square = (x.sum(0) for x in lin.gram())
    own = lin.problem.unknowns.owned
    chi2 = float(square) + float((lin.point.z[own] ** 2).sum())
    log_det = np.linalg.slogdet(gram[np.ix_(own, own)] + np.eye(len(own)))[1] if len(own) else 0.0
    return chi2, lin.latent.log_normalizer - 0.5 * float(log_det)


def _warm(length: int) -> int:
    return min(max(LEAST_WARM_UP, round(WARM_UP * length)), length // 2)


def _rollout(problem: Problem, z: np.ndarray) -> Float[np.ndarray, "segments samples columns"]:
    """Predictions from states estimated from each stretch's first samples."""
    segments = problem.segments
    first = segments.values.copy()
    for s in range(segments.count):
        first[s, _warm(int(segments.lengths[s])) :] = np.nan
    lin = fit_starts(replace(problem, segments=replace(segments, values=first)), z)
    if lin is None:
        return problem.simulator.rollout(problem.request(z[None], problem.guess.start))
    return problem.simulator.rollout(problem.request(lin.point.z[None], lin.point.start))


def leave_one_out(fit: Fit) -> dict[str, np.ndarray]:
    """The unknowns refitted without each recording, by one Gauss-Newton step from the full fit."""
    gram, slope, _ = fit.linear.gram()
    owner, s2 = fit.problem.segments.recording, fit.noise_scale
    out = {}
    for r, recording in enumerate(fit.problem.segments.recordings):
        keep = owner != r
        precision = gram[keep].sum(0) / s2 + np.eye(fit.problem.size)
        gradient = slope[keep].sum(0) / s2 - fit.point.z
        step = np.linalg.solve(precision, gradient) if fit.problem.size else np.zeros(0)
        out[recording.name] = fit.point.z + step
    return out


def held_out(fit: Fit) -> HeldOut:
    """Scores on the study's held-out recordings, or, where it has none, on each recording left out in turn.

    A single recording is scored as it was fitted: nothing can be left out.
    """
    study = fit.problem.simulator.study
    if study.holdout:
        return evaluate(fit, dict.fromkeys((r.name for r in study.holdout), fit.point.z), study.holdout)
    if len(study.recordings) == 1:
        return fitted(fit)
    return evaluate(fit, leave_one_out(fit), study.recordings)


def fitted(fit: Fit) -> HeldOut:
    """The same for the recordings that were fitted, for pictures."""
    study = fit.problem.simulator.study
    return evaluate(fit, dict.fromkeys((r.name for r in study.recordings), fit.point.z), study.recordings)


def share_explained(believed: HeldOut, base: HeldOut, better: HeldOut) -> float:
    """Share of the believed model's held-out squared excess that goes when `base` becomes `better`."""
    excess = excess_beyond_chance(believed)
    return float(np.clip((base.chi2.sum() - better.chi2.sum()) / excess, -1.0, 1.0)) if excess else 0.0


def excess_beyond_chance(scores: HeldOut) -> float:
    """Squared whitened error in excess of noise, 0 while noise alone may well have made it."""
    values = scores.num_values.sum()
    excess = float(scores.chi2.sum() - values)
    return excess if excess > CHANCE * np.sqrt(2 * values) else 0.0
