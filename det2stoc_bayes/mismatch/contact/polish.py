"""Fits where contact makes the likelihood bumpy: Gauss-Newton ends at the nearest bump, evolution goes beyond it."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.evolution import evolved
from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, sds, within
from det2stoc_bayes.mismatch.contact.regions import free_unknowns

BUMPY = 5.0  # nats of bumps from which on it is worth the time
POPULATION, GENERATIONS = 12, 10
WIDTH = 2.0  # posterior sds in which it begins


def polished(fit: ContactFit) -> ContactFit:
    """The likeliest that evolution finds about a fit; a region's border stays where it is."""
    free = free_unknowns(fit)
    if not len(free):
        return fit
    root = sds(fit.gram[np.ix_(free, free)])

    def unknowns(x: Float[np.ndarray, " size"]) -> Float[np.ndarray, " unknowns"]:
        z = fit.z.copy()
        z[free] += root @ x
        return within(fit, z)

    best = evolved(fit, unknowns, size=len(free), sigma=WIDTH, population=POPULATION, generations=GENERATIONS)
    return fit if best is fit.z else replace(at(fit.followed, best), sizes=fit.steps)
