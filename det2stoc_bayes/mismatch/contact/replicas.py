"""Windows as a model itself would make them: what noise, contact and estimated starts do when nothing is missing."""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.contact.window_fit import WindowFit
from det2stoc_bayes.mismatch.contact.window_starts import smoothed
from det2stoc_bayes.mismatch.contact.windows import Windows
from det2stoc_bayes.starts import guess_starts


def replicated(fit: WindowFit, random: np.random.Generator) -> Windows:
    """The same windows with samples from the fit's own simulation and fresh noise, starts estimated anew."""
    windows = fit.windows.fine()
    problem = windows.problem
    segments, predicted = problem.segments, windows.predicted(fit.z)
    values = predicted + problem.noise * random.standard_normal(predicted.shape)
    values = np.where(segments.observed & np.isfinite(values), values, np.nan)
    made = replace(segments, values=values)
    guess = guess_starts(problem.simulator.model, made)
    return smoothed(windows.with_problem(replace(problem, segments=made, guess=guess)), fit.z)
