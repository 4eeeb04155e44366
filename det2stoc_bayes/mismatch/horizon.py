"""How long a stretch the simulator can be asked to predict: as long as its error stays small beside the motion."""

from collections.abc import Iterator

import numpy as np

from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, whitened
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.segments import cut
from det2stoc_bayes.start_fit import searched_again

SHORTEST = 20  # samples
GROWTH, LEAST_GROWTH = 4, 2  # from one rung to the next; and from the last one to whole recordings
LARGEST_ERROR = 0.2  # of a column's spread: beyond it a linearization says little


def ladder(problem: Problem) -> Iterator[int | None]:
    """Numbers of samples to try in turn; None stands for whole recordings."""
    longest = max(len(r.time) for r in problem.segments.recordings)
    n = SHORTEST
    while LEAST_GROWTH * n <= longest:
        yield n
        n *= GROWTH
    yield None


def climb(problem: Problem, z: np.ndarray | None = None) -> Fit | None:
    """The fit at the longest horizon whose error is still small, reached from short segments up."""
    best: Fit | None = None
    z = np.zeros(problem.size) if z is None else z
    for n in ladder(problem):
        at = problem.on(cut(problem.segments.recordings, n, problem.segments.columns))
        fit = fit_many([(at, start_point(at, z, best and best.linear))], tolerance=0.5)[0]
        if fit is None or (best is not None and relative_error(fit) > LARGEST_ERROR):
            break
        best, z = fit, fit.point.z
    return best and searched_again(best, tolerance=0.5)


def extend(fit: Fit) -> Fit:
    """The same hypothesis at a longer horizon, where one has become possible."""
    recordings = fit.problem.segments.recordings
    whole = fit.problem.on(cut(recordings, None, fit.problem.segments.columns))
    if fit.problem.segments.count == whole.segments.count:
        return fit
    longer = fit_many([(whole, start_point(whole, fit.point.z, fit.linear))], tolerance=0.5)[0]
    if longer is None or longer.noise_inflation >= MODEL_ERROR:  # by way of shorter ones, lest it be a false optimum
        longer = climb(fit.problem, fit.point.z)
    return fit if longer is None or longer.problem.segments.count >= fit.problem.segments.count else longer


def relative_error(fit: Fit) -> float:
    """Largest residual rms of a column, the noise's taken off, beside that column's spread."""
    r = whitened(fit)
    with np.errstate(invalid="ignore"):
        rms = fit.problem.noise * np.sqrt(np.maximum(np.nanmean(r**2, axis=(0, 1)) - 1.0, 0.0))
        spread = np.nanstd(fit.problem.segments.values, axis=(0, 1))
    signal = spread > 5 * fit.problem.noise  # a column that hardly moves says nothing about the horizon
    return float(np.max(rms[signal] / spread[signal], initial=0.0))
