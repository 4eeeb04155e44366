"""The No-U-Turn sampler of BlackJAX, preconditioned by the mode's Gaussian; chains simulate in one batch."""

import jax
import jax.numpy as jnp
import numpy as np

from det2stoc_bayes.density_jax import jax_log_prior
from det2stoc_bayes.inference._sampling import (
    Gradient,
    Target,
    advance,
    as_key,
    mode_of,
    normal_draws,
    numpy_random,
    per_chain,
    seed_of,
    stacked,
)
from det2stoc_bayes.posterior import DataTree, Progress, build, measured
from det2stoc_bayes.vector_density import Inferred


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    num_chains: int = 4,
    num_warmup: int = 40,
    target_accept: float = 0.8,
    max_tree_depth: int = 8,
    gradient: Gradient = "auto",
    progress: Progress | None = None,
) -> DataTree:
    """`num_samples` draws in all. The warm-up tunes one step size for all chains (dual averaging)."""
    import blackjax
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    options = {
        "num_samples": num_samples,
        "num_chains": num_chains,
        "num_warmup": num_warmup,
        "target_accept": target_accept,
        "max_tree_depth": max_tree_depth,
        "gradient": gradient,
    }
    key = as_key(key)
    with measured(problem) as cost:
        mode, random = mode_of(problem), numpy_random(key)
        target = Target(mode, random, gradient)
        kernel, covariance = blackjax.nuts.build_kernel(), jnp.asarray(mode.scale @ mode.scale.T)
        begin, update, final = dual_averaging_adaptation(target_accept)

        def log_density(z):
            return target.terms(z).sum() + jax_log_prior(z)

        def step(carry):
            i, key, states, tuning = carry
            key, *keys = jax.random.split(key, num_chains + 1)
            size = jnp.exp(jnp.where(i < num_warmup, tuning.log_step_size, tuning.log_step_size_avg))

            def move(key, state):
                return kernel(key, state, log_density, size, covariance, max_tree_depth)

            states, info = jax.vmap(move)(jnp.stack(keys), states)
            tuned = update(tuning, info.acceptance_rate.mean())
            tuning = jax.tree.map(lambda new, old: jnp.where(i < num_warmup, new, old), tuned, tuning)
            return (i + 1, key, states, tuning), {
                "z": states.position,
                "acceptance_rate": info.acceptance_rate,
                "n_steps": info.num_integration_steps,
                "diverging": info.is_divergent,
                "energy": info.energy,
                "step_size": jnp.broadcast_to(size, (num_chains,)),
                "tree_depth": info.num_trajectory_expansions,
            }

        first = jnp.asarray(normal_draws(mode, random, num_chains))
        states = jax.vmap(lambda z: blackjax.nuts.init(z, log_density))(first)
        num_draws = per_chain(num_samples, num_chains)
        carry = (jnp.asarray(0), key, states, begin(1.0))
        _, reports = advance(step, carry, num_warmup + num_draws, cost, progress)
        if target.exact:
            target.book(sum(int(r["n_steps"].sum()) for r in reports))
        stats = stacked(reports[num_warmup:])
        z = np.asarray(stats.pop("z"))
        return build(
            mode.density,
            z,
            method="blackjax_nuts",
            options=options,
            seed=seed_of(key),
            cost=cost,
            sample_stats=stats,
            log_likelihood=target.by_recording(z),
        )
