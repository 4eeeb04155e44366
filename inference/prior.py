"""Draws of the prior, with the declared likelihood of each."""

import jax

from det2stoc_bayes.density import Density
from det2stoc_bayes.inference._sampling import NUM_CHAINS, as_key, numpy_random, per_chain, seed_of
from det2stoc_bayes.map import find_map
from det2stoc_bayes.posterior import DataTree, build, measured
from det2stoc_bayes.vector_density import Inferred, VectorDensity
from det2stoc_bayes.vector_problem import Posed


def fit(problem: Inferred, key: int | jax.Array, *, num_samples: int = 1000) -> DataTree:
    """`num_samples` independent draws."""
    key = as_key(key)
    with measured(problem) as cost:
        posed = isinstance(problem, Posed)
        density = VectorDensity.of_prior(problem) if posed else Density.at(find_map(problem))
        z = numpy_random(key).standard_normal((NUM_CHAINS, per_chain(num_samples, NUM_CHAINS), density.size))
        terms = density.log_likelihood_by_recording(z.reshape(-1, density.size))
        return build(
            density,
            z,
            method="prior",
            options={"num_samples": num_samples},
            seed=seed_of(key),
            cost=cost,
            sample_stats={},
            log_likelihood=terms.reshape(*z.shape[:2], -1),
        )
