"""The likeliest of many unknowns drawn about a fit: beyond the bumps that contact makes no derivative leads."""

from collections.abc import Callable

import numpy as np
from cmaes import CMA
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.fit import ContactFit, losses_at

SEED = 6
PATIENCE = 4  # generations without a better one, after which it ends


def evolved(
    fit: ContactFit,
    unknowns: Callable[[Float[np.ndarray, " size"]], Float[np.ndarray, " unknowns"]],
    *,
    size: int,
    sigma: float,
    population: int,
    generations: int,
) -> Float[np.ndarray, " unknowns"]:
    """The likeliest unknowns by CMA-ES (Hansen, 2016) over coordinates about 0, the fit; its own if none is better."""
    width = max(size, 2)  # of one dimension CMA-ES knows nothing: another stands idle
    search = CMA(mean=np.zeros(width), sigma=sigma, seed=SEED, population_size=population)
    best, least, since = fit.z, fit.loss, 0
    for _ in range(generations):
        asked = [search.ask() for _ in range(population)]
        z = np.stack([unknowns(x[:size]) for x in asked])
        losses = losses_at(fit, z)
        search.tell([(x, float(loss)) for x, loss in zip(asked, losses, strict=True)])
        since += 1
        if losses.min() < least:
            best, least, since = z[int(losses.argmin())], float(losses.min()), 0
        if since >= PATIENCE:
            break
    return best
