"""How well recordings that were not fitted are predicted, before and after."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.engines.base import Request
from det2stoc_bayes.linearization import Linearization
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import Segments, cut
from det2stoc_bayes.start_fit import fit_starts

WARM_UP = 0.1  # of a stretch: the samples from which its initial state is estimated
LEAST_WARM_UP = 10  # samples
ALIKE = 1.5  # times as long: recordings that are simulated together
DIVERGED = 1e6  # whitened squared error a value at which a diverged rollout is counted


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Scores of one hypothesis, one entry a held-out recording, and the rollouts behind them."""

    names: tuple[str, ...]
    samples: int | None  # of a rollout; None: whole recordings
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


def horizon_samples(*fits: Fit) -> int | None:
    """Samples of a rollout that all fits can be asked for: their shortest stretches; None for whole recordings."""
    parts = [f.problem.segments for f in fits if not f.problem.segments.whole]
    return min((int(np.median(s.lengths)) for s in parts), default=None)


def evaluate(
    fit: Fit, z_by_recording: dict[str, np.ndarray], recordings: tuple[Recording, ...], samples: int | None
) -> HeldOut:
    """Scores of recordings under the unknowns given for each of them, in rollouts of so many samples."""
    alike: dict[bytes, list[Recording]] = {}
    for r in recordings:
        alike.setdefault(z_by_recording[r.name].tobytes(), []).append(r)
    scores: dict[str, _Score] = {}
    for same in alike.values():
        for group in _together(same):
            scores |= _scores(fit, z_by_recording[group[0].name], group, samples)
    names = tuple(r.name for r in recordings)
    listed = [scores[name] for name in names]
    return HeldOut(
        names,
        samples,
        np.array([s.log_density for s in listed]),
        np.array([s.chi2 for s in listed]),
        np.array([s.num_values for s in listed]),
        np.array([s.squared_error for s in listed]),
        np.array([s.num_errors for s in listed]),
        {name: s.rollout for name, s in zip(names, listed, strict=True)},
    )


@dataclass(frozen=True, eq=False)
class _Score:
    """One recording's part of a HeldOut."""

    log_density: float
    chi2: float
    num_values: float
    squared_error: Float[np.ndarray, " columns"]
    num_errors: Float[np.ndarray, " columns"]
    rollout: Float[np.ndarray, "samples columns"]


def foretold(fit: Fit, z: np.ndarray, recordings: tuple[Recording, ...]) -> dict[str, float]:
    """Each recording's whitened squared error of rollouts from states that are estimated from the samples before."""
    return {name: e for group in _together(recordings) for name, e in _foretold(fit, z, group).items()}


def _foretold(fit: Fit, z: np.ndarray, recordings: tuple[Recording, ...]) -> dict[str, float]:
    problem, posed = _posed(fit, z, recordings, horizon_samples(fit))
    segments, predicted = problem.segments, _rollout(problem, posed)
    if not np.isfinite(predicted).all():
        if len(recordings) > 1:
            return {name: e for r in recordings for name, e in _foretold(fit, z, (r,)).items()}
        return {r.name: DIVERGED * float(segments.observed.sum()) for r in recordings}
    error = problem.residuals(predicted).reshape(segments.values.shape)
    whitened = problem.measurement.bend(np.where(_counted(segments), error / problem.noise, 0.0))
    squares = np.bincount(segments.recording, (whitened**2).sum((1, 2)), len(recordings))
    return {r.name: float(e) for r, e in zip(segments.recordings, squares, strict=True)}


def _together(recordings: Sequence[Recording]) -> list[tuple[Recording, ...]]:
    """Groups of similar length: all of a group are simulated as long as its longest."""
    groups: list[list[Recording]] = []
    for r in sorted(recordings, key=lambda r: len(r.time)):
        if not groups or len(r.time) > ALIKE * len(groups[-1][0].time):
            groups.append([])
        groups[-1].append(r)
    return [tuple(g) for g in groups]


def _posed(
    fit: Fit, z: np.ndarray, recordings: tuple[Recording, ...], samples: int | None
) -> tuple[Problem, np.ndarray]:
    """The same hypothesis on other recordings, in stretches of so many samples."""
    problem = fit.problem.on(cut(recordings, samples, fit.problem.segments.columns))
    return problem, fit.problem.carry(z, problem)


def _scores(fit: Fit, z: np.ndarray, recordings: tuple[Recording, ...], samples: int | None) -> dict[str, _Score]:
    """Recordings with the same unknowns are simulated together, unless one of them diverges."""
    problem, posed = _posed(fit, z, recordings, samples)
    segments, lin = problem.segments, fit_starts(problem, posed)
    predicted = np.array(np.nan) if lin is None else _rollout(problem, posed)
    if lin is None or not np.isfinite(predicted).all():  # a start that its warm-up fits may still lead astray
        if len(recordings) > 1:
            return {name: s for r in recordings for name, s in _scores(fit, z, (r,), samples).items()}
        return {r.name: _diverged(segments, r) for r in recordings}
    chi2, normalizer = _integrated(lin)
    error = problem.residuals(predicted).reshape(segments.values.shape)
    counted, out = _counted(segments), {}
    error = np.where(counted, error, 0.0)
    for k, r in enumerate(recordings):
        mine = np.flatnonzero(segments.recording == k)
        values = segments.observed[mine].sum() - len(mine) * lin.latent.prior_sd.shape[1]
        out[r.name] = _Score(
            float(normalizer[k] - 0.5 * chi2[k]),
            float(chi2[k] / problem.measurement.mean_square),
            float(max(values, 1)),
            (error[mine] ** 2).sum((0, 1)),
            counted[mine].sum((0, 1)).astype(float),
            np.concatenate([predicted[s, : segments.lengths[s]] for s in mine]),
        )
    return out


def _counted(segments: Segments) -> Bool[np.ndarray, "segments samples columns"]:
    """Recorded values beyond the warm-up."""
    counted = segments.observed.copy()
    for s in range(segments.count):
        counted[s, : _warm(int(segments.lengths[s]))] = False
    return counted


def _diverged(segments: Segments, recording: Recording) -> _Score:
    width, values = len(segments.columns), float(segments.observed.sum())
    nothing = np.full((len(recording.time), width), np.nan)
    chi2 = DIVERGED * values
    return _Score(-0.5 * chi2, chi2, values, np.full(width, np.inf), np.ones(width), nothing)


def _integrated(lin: Linearization) -> tuple[Float[np.ndarray, " recordings"], Float[np.ndarray, " recordings"]]:
    """chi2 and log normalizer of each recording, with starts and values of psi by recording integrated out."""
    gram, _, square = lin.gram()
    owner, own = lin.problem.segments.recording, lin.problem.unknowns.own
    chi2, normalizer = [], []
    for k in range(len(lin.problem.segments.recordings)):
        mine, held = owner == k, np.array([rows[k] for rows in own], int)
        inner = gram[mine].sum(0)[np.ix_(held, held)] + np.eye(len(held))
        log_det = np.linalg.slogdet(inner)[1] if len(held) else 0.0
        chi2.append(square[mine].sum() + (lin.point.z[held] ** 2).sum())
        normalizer.append(lin.latent.log_normalizers[mine].sum() - 0.5 * log_det)
    return np.array(chi2), np.array(normalizer)


def _warm(length: int) -> int:
    return min(max(LEAST_WARM_UP, round(WARM_UP * length)), length // 2)


def predicted_states(
    fit: Fit, recordings: tuple[Recording, ...], samples: int | None
) -> dict[str, Float[np.ndarray, "samples nq"]]:
    """The positions behind the rollouts of recordings that were not fitted; NaN where a rollout diverged."""
    out = {}
    for recording in recordings:
        problem, posed = _posed(fit, fit.point.z, (recording,), samples)
        segments, found = problem.segments, problem.simulator.engine.trajectory(_from_warm_up(problem, posed)).qpos
        out[recording.name] = np.concatenate([found[s, : segments.lengths[s]] for s in range(segments.count)])
    return out


def _rollout(problem: Problem, z: np.ndarray) -> Float[np.ndarray, "segments samples columns"]:
    """Predictions from states estimated from each stretch's first samples."""
    return problem.simulator.rollout(_from_warm_up(problem, z))


def _from_warm_up(problem: Problem, z: np.ndarray) -> Request:
    """Simulations from such states."""
    segments = problem.segments
    warm = np.array([_warm(int(n)) for n in segments.lengths])
    longest = int(warm.max())  # what comes later need not be simulated
    later = np.arange(longest) >= warm[:, None]
    values = np.where(later[..., None], np.nan, segments.values[:, :longest])
    beginning = replace(segments, time=segments.time[:, :longest], values=values)
    lin = fit_starts(replace(problem, segments=beginning), z)
    if lin is None:
        return problem.request(z[None], problem.guess.start)
    return problem.request(lin.point.z[None], lin.point.start)


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


def held_out(fit: Fit, *beside: Fit) -> HeldOut:
    """Scores on the study's held-out recordings, or, where it has none, on each recording left out in turn.

    Rollouts are as long as the stretches of the fit, or of those `beside` it where these follow less far: what is
    compared is asked for the same. A single recording is scored as it was fitted: nothing can be left out.
    """
    study, samples = fit.problem.simulator.study, horizon_samples(fit, *beside)
    if study.holdout:
        return evaluate(fit, dict.fromkeys((r.name for r in study.holdout), fit.point.z), study.holdout, samples)
    if len(study.recordings) == 1:
        return fitted(fit, *beside)
    return evaluate(fit, leave_one_out(fit), study.recordings, samples)


def fitted(fit: Fit, *beside: Fit) -> HeldOut:
    """The same for the recordings that were fitted."""
    records = fit.problem.simulator.study.recordings
    return evaluate(fit, dict.fromkeys((r.name for r in records), fit.point.z), records, horizon_samples(fit, *beside))
