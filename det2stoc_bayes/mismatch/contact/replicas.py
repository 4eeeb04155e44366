"""Recordings as a model itself would make them: what noise and contact do when nothing is missing."""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.followed import Followed


def replicated(fit: ContactFit, random: np.random.Generator) -> Followed:
    """The same starts and times, with innovations drawn anew: the model's own motion, and samples of it."""
    followed = fit.followed
    segments = followed.problem.segments
    made = followed.drawn(fit.z, random)
    values = np.where(segments.observed & np.isfinite(made), made, np.nan)
    values[:, 0] = segments.values[:, 0]
    return replace(followed, problem=followed.problem.on(replace(segments, values=values)))
