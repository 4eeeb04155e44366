"""How sure a hypothesis is of its unknowns, by where fits end that begin about it.

Along valleys, which contact makes rough, fits of one hypothesis end apart though recordings tell none of them better
than bumps do. What is told of one of them is no surer than that.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import ContactFit, fit_followed, within
from det2stoc_bayes.mismatch.contact.regions import free_unknowns
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.contact.top import widened

NUM_ENDS = 4  # two directions, either way
APART = 3.0  # sds about the fit at which others begin
SETTLED = 0.3  # nats: a step that gains less is the last one
LUCKY = 3.0  # times the bumps: an end that is told so much worse than the best is none


def no_surer_than_ends(
    fit: ContactFit, luck: float, random: np.random.Generator, advance: Callable[[int], None]
) -> ContactFit:
    """The hypothesis, its covariance widened by how far from it fits end that begin some sds away.

    Bumps are `luck` nats high. Where a region ends stays, for no fit moves that. `advance` hears how many have ended.
    """
    free = free_unknowns(fit)
    if not len(free):
        return fit
    root = np.linalg.cholesky(fit.covariance[np.ix_(free, free)])
    half = APART * random.standard_normal((NUM_ENDS // 2, len(free)))
    starts = np.tile(fit.z, (NUM_ENDS, 1))
    starts[:, free] += np.concatenate([half, -half]) @ root.T
    held = np.setdiff1d(np.arange(len(fit.z)), free).tolist()
    begun = replace(fit, sizes=fit.steps)
    begun.prepare()

    def ended(z: np.ndarray) -> ContactFit:
        return fit_followed(fit.followed, within(fit, z), held=held, settled=SETTLED, like=begun)

    ends = side_by_side(fit.problem, ended, list(starts), advance)
    least = min(f.loss for f in [fit, *ends])
    return widened(fit, *(f.z for f in ends if f.loss < least + LUCKY * luck))
