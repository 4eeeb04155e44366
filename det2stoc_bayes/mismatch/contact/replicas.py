"""Recordings as a model itself would make them: what noise and contact do when nothing is missing."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.followed import Followed


def replicated(fit: ContactFit, random: np.random.Generator) -> Followed:
    """The same starts and times, with innovations drawn anew: the model's own motion, and samples of it."""
    return _recorded(fit.followed, fit.followed.drawn(fit.z, random))


def moved_freely(fit: ContactFit, random: np.random.Generator) -> Followed:
    """The same starts and times, as the model moves on from there when nothing leads it, and noise.

    What is led is pushed anew at every sample: where bodies rattle, that alone makes them rattle.
    """
    problem = fit.problem
    moved = problem.simulator.rollout(problem.request(fit.z[None], fit.followed.start))
    return _recorded(fit.followed, moved + problem.noise * random.standard_normal(moved.shape))


def made_alone(fit: ContactFit, random: np.random.Generator) -> Followed:
    """What the model makes when nothing leads it, or else, where it diverges then, what it makes led."""
    free = moved_freely(fit, random)
    return free if complete(free, fit) else replicated(fit, random)


def complete(made: Followed, fit: ContactFit) -> bool:
    """Whether everything that was recorded has been made."""
    return bool((np.isfinite(made.problem.segments.values) == np.isfinite(fit.problem.segments.values)).all())


def _recorded(followed: Followed, made: Float[np.ndarray, "recordings samples columns"]) -> Followed:
    """What was made, where something was recorded."""
    segments = followed.problem.segments
    values = np.where(segments.observed & np.isfinite(made), made, np.nan)
    values[:, 0] = segments.values[:, 0]
    return replace(followed, problem=followed.problem.on(replace(segments, values=values)))
