"""Fits where contact makes the likelihood bumpy: Gauss-Newton ends at the nearest bump, evolution goes beyond it."""

import numpy as np
from cmaes import CMA

from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, losses_at, sds, within
from det2stoc_bayes.mismatch.contact.regions import border_unknowns

BUMPY = 5.0  # nats of bumps from which on it is worth the time
POPULATION, GENERATIONS = 12, 10
WIDTH = 2.0  # posterior sds in which it begins
SEED = 6


def polished(fit: ContactFit) -> ContactFit:
    """The likeliest that CMA-ES (Hansen, 2016) finds about a fit; a region's border stays where it is."""
    free = np.setdiff1d(np.arange(len(fit.z)), border_unknowns(fit))
    if not len(free):
        return fit
    root = sds(fit.gram[np.ix_(free, free)])
    size = max(len(free), 2)  # of one dimension CMA-ES knows nothing: another stands idle
    search = CMA(mean=np.zeros(size), sigma=WIDTH, seed=SEED, population_size=POPULATION)
    best, least = fit.z, fit.loss
    for _ in range(GENERATIONS):
        asked = [search.ask() for _ in range(POPULATION)]
        z = np.tile(fit.z, (POPULATION, 1))
        z[:, free] += np.array(asked)[:, : len(free)] @ root.T
        z = np.stack([within(fit, row) for row in z])
        losses = losses_at(fit, z)
        search.tell([(x, float(loss)) for x, loss in zip(asked, losses, strict=True)])
        k = int(losses.argmin())
        if losses[k] < least:
            best, least = z[k], float(losses[k])
    return fit if best is fit.z else at(fit.followed, best)
