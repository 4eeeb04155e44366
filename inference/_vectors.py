"""Neural posterior estimation on problems of vectors: x is learned from as it is."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.inference._flow import ConditionalFlow, Training
from det2stoc_bayes.inference._flow import train as train_flow
from det2stoc_bayes.inference._refine import SURPLUS, Refine, Weighed, build_weighed, num_proposed
from det2stoc_bayes.inference._sampling import NUM_CHAINS, as_key, numpy_random, per_chain, seed_of
from det2stoc_bayes.posterior import DataTree, Progress, build_vectors, measured
from det2stoc_bayes.psis import effective_draws, resampled, smooth
from det2stoc_bayes.vector_density import VectorDensity
from det2stoc_bayes.vector_problem import Posed, VectorProblem


def train(
    problem: VectorProblem, key: int | jax.Array, *, num_simulations: int = 10_000, training: Training | None = None
) -> ConditionalFlow:
    """Flows that serve for every x."""
    key = as_key(key)
    z, x = problem.draw(num_simulations, numpy_random(key))
    return train_flow(z, x, key, training or Training())


def fit(problem: Posed, key: int | jax.Array, options: Mapping[str, Any], progress: Progress) -> DataTree:
    """As `npe.fit`, whose options these are, of a problem of vectors."""
    refine, each = options["refine"], per_chain(options["num_samples"], NUM_CHAINS)
    proposed = NUM_CHAINS * num_proposed(each, refine)
    training = Training(**{name: options[name] for name in ("num_members", "width", "patience", "num_epochs")})
    learn, draw = jax.random.split(key := as_key(key))
    with measured(problem) as cost:
        density, random = VectorDensity.of_prior(problem), numpy_random(key)
        z, x = problem.problem.draw(options["num_simulations"], random)
        problem.counter.simulations += len(z)
        flow = train_flow(z, x, learn, training, progress=progress)
        drawn = flow.sample(draw, problem.x, proposed)
        return build_weighed(
            density,
            Weighed.of(density, drawn, flow.log_density(drawn, problem.x)),
            NUM_CHAINS,
            refine,
            random,
            sample_stats={"loss": (("epoch",), flow.history.mean(1))},
            method="npe",
            options=options,
            seed=seed_of(key),
            cost=cost,
        )


def refined(
    problem: VectorProblem,
    flow: ConditionalFlow,
    x: Float[np.ndarray, " features"],
    key: jax.Array,
    count: int,
    proposed: int,
) -> tuple[Float[np.ndarray, "count size"], float, float]:
    """`count` of the flow's draws by Pareto-smoothed weights of the exact likelihood; k-hat, effective draws."""
    z = flow.sample(key, x, proposed)
    log_weights, k_hat = smooth(problem.log_density(z, x) - flow.log_density(z, x))
    weights = np.exp(log_weights)
    return z[resampled(weights, count, numpy_random(key))], k_hat, effective_draws(weights)


def apply(
    flow: ConditionalFlow,
    problem: VectorProblem,
    x: Float[np.ndarray, " features"],
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    refine: Refine = "none",
) -> DataTree:
    """Draws of the learned posterior of one x; `refine`: "psis" resamples by the exact likelihood."""
    key = as_key(key)
    each = per_chain(num_samples, NUM_CHAINS)
    proposed, told = NUM_CHAINS * num_proposed(each, refine), {}
    if refine == "none":
        z = flow.sample(key, x, proposed)
    else:
        z, k_hat, effective = refined(problem, flow, x, key, proposed // SURPLUS, proposed)
        told = {"k_hat": k_hat, "effective_draws": effective, "num_weighed": proposed}
    theta = problem.constrained(z).reshape(NUM_CHAINS, each, -1)
    z = z.reshape(theta.shape)
    return build_vectors(problem.names, theta, z, method="npe", seed=seed_of(key), **told)
