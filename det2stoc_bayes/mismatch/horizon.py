"""How long a stretch the simulator can be asked to predict: as long as its error stays small beside the motion."""

import math
from collections.abc import Iterator

import numpy as np

from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, whitened
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.segments import Segments, cut
from det2stoc_bayes.start_fit import fit_starts, searched_again

SHORTEST = 20  # samples
GROWTH, LEAST_GROWTH = 4, 2  # from one rung to the next; and from the last one to whole recordings
AMPLE = 3000  # samples in short segments: under a misfit more of them cost time and decide nothing
SEARCHED = 600  # samples, or up to four times as many, in short segments where dozens of starts are tried for each
FAR = 100.0  # noise inflation from which on a search holds a hypothesis against others where it stands
LARGEST_ERROR = 0.2  # of a column's spread: beyond it a linearization says little


def ladder(problem: Problem) -> Iterator[int | None]:
    """Numbers of samples to try in turn; None stands for whole recordings."""
    longest = max(len(r.time) for r in problem.segments.recordings)
    n = SHORTEST
    while LEAST_GROWTH * n <= longest:
        yield n
        n *= GROWTH
    yield None


def climb(
    problem: Problem, z: np.ndarray | None = None, reached: Fit | None = None, *, until: Segments | None = None
) -> Fit | None:
    """The fit at the longest horizon (no longer than `until`) whose error is still small.

    From short segments on, or from a fit `reached`; None where simulations diverge, or no rung is so short.

    Of many short segments some lead the way. All are fitted in the end, or, where a misfit stays, the telling ones.
    """
    best, stretches = reached, problem.segments
    z = np.zeros(problem.size) if z is None else z
    for n in ladder(problem):
        every = cut(problem.segments.recordings, n, problem.segments.columns)
        if reached is not None and not _longer(every, reached.problem.segments):
            stretches = every
            continue
        if until is not None and _longer(every, until):
            break
        some = every if n is None else _leading(problem, every)
        fit = _on(problem, some, z, best)
        if fit is None or (best is not None and _lost(fit) and not _recovers(fit, best)):
            break
        best, stretches, z = fit, every, fit.point.z
    if best is None:
        return None
    if best.problem.segments.count < stretches.count and (best is not reached or best.noise_inflation < MODEL_ERROR):
        chosen = stretches if best.noise_inflation < MODEL_ERROR else _telling(best, stretches)
        best = _on(problem, chosen, z, best) or best
    return best if best is reached else searched_again(best, tolerance=0.5)


def _lost(fit: Fit) -> bool:
    """Whether stretches are too long to linearize about.

    The error is too large, or, where starts are searched for, the search did not end and is far from the noise.
    """
    astray = fit.end != "converged" and fit.noise_inflation >= FAR
    return (astray and not fit.problem.guess.seen.all()) or relative_error(fit) > LARGEST_ERROR


def _recovers(fit: Fit, shorter: Fit) -> bool:
    """Whether an effect that remembers, and starts anew at every cut, tells longer stretches better."""
    remembers = any(e.effect.uses("anchor") for e in fit.problem.effects)
    return remembers and relative_error(fit) < relative_error(shorter)


def _leading(problem: Problem, segments: Segments) -> Segments:
    """As many segments as lead the way to longer ones: of searched starts those that longer ones begin with."""
    num_samples = int(segments.lengths.sum())
    if problem.guess.seen.all():
        return segments.only(segments.evenly(AMPLE)) if num_samples > AMPLE else segments
    rungs = math.floor(math.log(max(num_samples / SEARCHED, 1.0), GROWTH))
    return segments.only(segments.beginnings(GROWTH**rungs)) if rungs else segments


def _telling(fit: Fit, every: Segments) -> Segments:
    """Half of what is ample evenly spread, and then what a fit tells worst of all segments: most of its misfit."""
    if int(every.lengths.sum()) <= AMPLE:
        return every
    problem, rows = fit.problem.on(every), every.evenly(AMPLE / 2)
    lin = fit_starts(problem, fit.problem.carry(fit.point.z, problem))
    if lin is None:
        return every.only(every.evenly(AMPLE))
    left = lin.gram()[2]
    left[rows] = -1.0
    worst = np.argsort(-left)[: every.count - len(rows)]
    room = AMPLE - every.lengths[rows].sum()
    return every.only(np.sort(np.concatenate([rows, worst[np.cumsum(every.lengths[worst]) <= room]])))


def _longer(segments: Segments, other: Segments) -> bool:
    """Whether they are of a later rung; segments of one differ by a sample."""
    return segments.time.shape[1] > 0.75 * LEAST_GROWTH * other.time.shape[1]


def _on(problem: Problem, segments: Segments, z: np.ndarray, shorter: Fit | None) -> Fit | None:
    at = problem.on(segments)
    return fit_many([(at, start_point(at, z, shorter and shorter.linear))], tolerance=0.5)[0]


def extend(fit: Fit, *, far: bool = False) -> Fit:
    """The same hypothesis at a longer horizon, where one has become possible.

    While a search goes on, what leaves a misfit `far` beyond the noise is not extended: later steps would cost several
    times as much for what is likely to be added to.
    """
    if fit.problem.segments.whole or (fit.noise_inflation >= FAR and not far):
        return fit
    if fit.noise_inflation < MODEL_ERROR:
        whole = cut(fit.problem.segments.recordings, None, fit.problem.segments.columns)
        longer = _on(fit.problem, whole, fit.point.z, fit)
        if longer is not None and longer.noise_inflation < MODEL_ERROR:
            return longer
    # By way of shorter ones, lest it be a false optimum.
    return climb(fit.problem, fit.point.z, fit) or fit


def reaches(fit: Fit, other: Fit) -> bool:
    """Whether one predicts stretches at least as long as the other: rollouts are as long as these."""
    return fit.problem.segments.extent[0] >= other.problem.segments.extent[0]


def relative_error(fit: Fit) -> float:
    """Largest residual rms of a column, the noise's taken off, beside that column's spread."""
    r = whitened(fit)
    with np.errstate(invalid="ignore"):
        rms = fit.problem.noise * np.sqrt(np.maximum(np.nanmean(r**2, axis=(0, 1)) - 1.0, 0.0))
        spread = np.nanstd(fit.problem.segments.values, axis=(0, 1))
    signal = spread > 5 * fit.problem.noise  # a column that hardly moves says nothing about the horizon
    return float(np.max(rms[signal] / spread[signal], initial=0.0))
