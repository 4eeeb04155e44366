"""Which columns a model tells at all: what it foretells worse than no model does has no say."""

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.scales import scales_of

NUM_LAST = 3  # samples whose mean foretells the next one of what hardly moves


def telling(fit: ContactFit) -> Bool[np.ndarray, " columns"]:
    """Columns that are foretold as well as by their median over all samples, or by their last samples' mean.

    How a body that lies flat rattles depends on contact alone. Where simulations rattle and the body does not, a sensor
    that shows less of it would be told, whatever else is missing. All, if nothing is told.
    """
    problem, followed = fit.problem, fit.followed
    values = problem.segments.values / problem.noise
    mine = _told(fit.errors * np.exp(followed.log_spread))
    others = [values - np.nanmedian(values, axis=(0, 1)), values - _last(values)]
    rest = [_told(followed.in_blocks_of_noise(o)) for o in others]
    heard = mine <= np.min(rest, axis=0)
    return heard if heard.any() else np.ones_like(heard)


def _told(errors: Float[np.ndarray, "blocks samples columns"]) -> Float[np.ndarray, " columns"]:
    """-log likelihood of each column's errors in noise sds."""
    scales = scales_of(errors)
    return np.array([scales.only(j).losses(errors[..., [j]]).sum() for j in range(errors.shape[2])])


def _last(values: Float[np.ndarray, "recordings samples columns"]) -> np.ndarray:
    """The mean of the samples before each one."""
    out = np.full_like(values, np.nan)
    for j in range(1, values.shape[1]):
        part = values[:, max(j - NUM_LAST, 0) : j]
        there = np.isfinite(part)
        out[:, j] = np.where(there, part, 0.0).sum(1) / np.where(there.any(1), there.sum(1), np.nan)
    return out
