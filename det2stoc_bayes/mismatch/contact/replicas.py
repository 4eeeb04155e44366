"""Recordings as a model itself would make them: what noise and contact do when nothing is missing."""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.followed import Followed


def replicated(fit: ContactFit, random: np.random.Generator) -> Followed:
    """The same starts and times, with innovations drawn anew: the model's own motion, and samples of it."""
    finer, fine = fit.followed.problem.finer, fit.followed.fine()
    segments = fine.problem.segments
    made = fine.drawn(fit.z, random)
    values = np.where(segments.observed & np.isfinite(made), made, np.nan)
    values[:, 0] = segments.values[:, 0]
    problem = replace(fit.problem, finer=None).on(replace(segments, values=values))
    followed = replace(fine, problem=problem)
    return followed if finer is None else followed.shifted(fit.z, finer.timestep, finer.integrator)
