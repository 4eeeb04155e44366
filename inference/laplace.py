"""The Gaussian at the mode, in unconstrained space; draws carry their importance weights."""

import jax
import numpy as np

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.inference._refine import Refine, Weighed, build_weighed, num_proposed
from det2stoc_bayes.inference._sampling import (
    NUM_CHAINS,
    as_key,
    mode_of,
    normal_draws,
    numpy_random,
    per_chain,
    seed_of,
)
from det2stoc_bayes.posterior import DataTree, measured
from det2stoc_bayes.vector_density import Inferred


def fit(problem: Inferred, key: int | jax.Array, *, num_samples: int = 1000, refine: Refine = "none") -> DataTree:
    """Draws of N(mode, inverse curvature); `log_weight` is log target - log Gaussian.

    `refine`: "psis" resamples by the exact likelihood.
    """
    key = as_key(key)
    with measured(problem) as cost:
        mode, random = mode_of(problem), numpy_random(key)
        density, each = mode.density, per_chain(num_samples, NUM_CHAINS)
        z = normal_draws(mode, random, NUM_CHAINS * num_proposed(each, refine))
        u = np.linalg.solve(mode.scale, (z - mode.center).T).T
        gaussian = log_prior(u) - np.log(np.diag(mode.scale)).sum()
        return build_weighed(
            density,
            Weighed.of(density, z, gaussian),
            NUM_CHAINS,
            refine,
            random,
            sample_stats={},
            method="laplace",
            options={"num_samples": num_samples, "refine": refine},
            seed=seed_of(key),
            cost=cost,
        )
