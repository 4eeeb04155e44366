"""Where a finer integration would have the top of a likelihood: an impact that comes late is made up for by psi."""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import ContactFit, at
from det2stoc_bayes.mismatch.contact.regions import border_unknowns
from det2stoc_bayes.mismatch.contact.top import widened

FARTHEST = 3.0  # sds that it may lead


def converged(fit: ContactFit) -> ContactFit:
    """The hypothesis where integration of fourth order leads it in one step, and no surer than that step is long."""
    followed = fit.followed
    other = at(followed.integrated(followed.problem.timestep, "rk4"), fit.z, fit.scales)
    other.__dict__["differences"] = fit.differences
    shift = _newton(other) - _newton(fit)
    shift[border_unknowns(fit)] = 0.0
    shift *= min(1.0, FARTHEST / max(float(np.sqrt(shift @ np.linalg.solve(fit.covariance, shift))), 1e-12))
    there = at(followed, np.maximum(fit.z + shift, followed.problem.floor))
    return widened(replace(there, sizes=fit.sizes, flat=fit.flat, rough=fit.rough), fit.z)


def _newton(fit: ContactFit) -> np.ndarray:
    return np.linalg.solve(fit.gram, fit.slopes.sum(0) - fit.z)
