"""The Gaussian at the mode, in unconstrained space; draws carry their importance weights."""

import jax
import numpy as np

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.inference._sampling import as_key, mode_of, normal_draws, numpy_random, per_chain, seed_of
from det2stoc_bayes.posterior import DataTree, build, measured
from det2stoc_bayes.problem import Problem

NUM_CHAINS = 4  # independent draws; so that every method's result has the same shape


def fit(problem: Problem, key: int | jax.Array, *, num_samples: int = 1000) -> DataTree:
    """Draws of N(mode, inverse curvature); `log_weight` is log target - log Gaussian."""
    key = as_key(key)
    with measured(problem) as cost:
        mode = mode_of(problem)
        density = mode.density
        z = normal_draws(mode, numpy_random(key), NUM_CHAINS, per_chain(num_samples, NUM_CHAINS))
        flat = z.reshape(-1, density.size)
        terms = density.log_likelihood_by_recording(flat)
        u = np.linalg.solve(mode.scale, (flat - mode.center).T).T
        gaussian = log_prior(u) - np.log(np.diag(mode.scale)).sum()
        weight = (terms.sum(1) + log_prior(flat) - gaussian).reshape(z.shape[:2])
        return build(
            density,
            z,
            method="laplace",
            options={"num_samples": num_samples},
            seed=seed_of(key),
            cost=cost,
            sample_stats={"log_weight": weight},
            log_likelihood=terms.reshape(*z.shape[:2], -1),
        )
