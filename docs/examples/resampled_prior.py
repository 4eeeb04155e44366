"""Draws of the prior, resampled by their likelihood (Rubin 1987): exact where the prior is not much wider."""

import jax
import numpy as np

from det2stoc_bayes.density import Density
from det2stoc_bayes.inference._sampling import NUM_CHAINS, as_key, density_of, numpy_random, per_chain, seed_of
from det2stoc_bayes.posterior import DataTree, build, measured
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.psis import resampled, smooth


def fit(problem: Problem, key: int | jax.Array, *, num_samples: int = 1000, num_proposed: int = 10_000) -> DataTree:
    """`num_samples` of `num_proposed` draws of the prior, each as often as its likelihood wants."""
    key = as_key(key)
    with measured(problem) as cost:  # counts time and simulations
        density: Density = density_of(problem)  # the recordings' starts are integrated out
        random = numpy_random(key)
        proposed = random.standard_normal((num_proposed, density.size))  # every unknown is standard normal a priori
        terms = density.log_likelihood_by_recording(proposed)
        log_weights, _ = smooth(terms.sum(1))
        each = per_chain(num_samples, NUM_CHAINS)
        rows = resampled(np.exp(log_weights), NUM_CHAINS * each, random)
        shape = (NUM_CHAINS, each)
        return build(
            density,
            proposed[rows].reshape(*shape, density.size),
            method="resampled_prior",
            options={"num_samples": num_samples, "num_proposed": num_proposed},
            seed=seed_of(key),
            cost=cost,
            sample_stats={},
            log_likelihood=terms[rows].reshape(*shape, -1),
        )
