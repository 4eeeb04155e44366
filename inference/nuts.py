"""The No-U-Turn sampler of NumPyro, preconditioned by the mode's Gaussian; chains simulate in one batch."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import Density
from det2stoc_bayes.density_jax import jax_log_prior
from det2stoc_bayes.inference._sampling import (
    Gradient,
    Mode,
    Target,
    advance,
    as_key,
    mode_at,
    mode_of,
    normal_draws,
    numpy_random,
    per_chain,
    seed_of,
    stacked,
)
from det2stoc_bayes.posterior import Cost, DataTree, Progress, build, measured
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
    """`num_samples` draws in all. The warm-up tunes the step size alone: the mass is the mode's precision."""
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
        chains = sample(mode_of(problem), key, **options, cost=cost, progress=progress)
        return build(
            chains.target.density,
            chains.z,
            method="nuts",
            options=options,
            seed=seed_of(key),
            cost=cost,
            sample_stats=chains.stats,
            log_likelihood=chains.target.by_recording(chains.z),
        )


@dataclass(frozen=True, eq=False)
class Chains:
    """Draws and what the sampler says of them."""

    z: Float[np.ndarray, "chain draw size"]
    stats: dict[str, Any]
    target: Target


def sample(
    mode: Mode,
    key: jax.Array,
    *,
    num_samples: int,
    num_chains: int,
    num_warmup: int,
    target_accept: float,
    max_tree_depth: int,
    gradient: Gradient,
    cost: Cost,
    progress: Progress | None,
) -> Chains:
    """Chains of the density whose mode is given; options as `fit`'s."""
    from numpyro.infer import NUTS

    random = numpy_random(key)
    target = Target(mode, random, gradient)
    # `Density.numpyro_model` in its unconstrained form, which spares NumPyro's search of sites.
    kernel = NUTS(
        potential_fn=lambda z: -(target.terms(z).sum() + jax_log_prior(z)),
        step_size=1.0,
        inverse_mass_matrix=jnp.asarray(mode.scale @ mode.scale.T),
        dense_mass=True,
        adapt_mass_matrix=False,
        target_accept_prob=target_accept,
        max_tree_depth=max_tree_depth,
    )
    first = jnp.asarray(normal_draws(mode, random, num_chains))
    state = kernel.init(jax.random.split(key, num_chains), num_warmup, first, (), {})

    def step(state):
        state = kernel.sample(state, (), {})
        return state, {
            "z": state.z,
            "acceptance_rate": state.accept_prob,
            "n_steps": state.num_steps,
            "diverging": state.diverging,
            "energy": state.energy,
            "step_size": state.adapt_state.step_size,
        }

    _, reports = advance(step, state, num_warmup + per_chain(num_samples, num_chains), cost, progress)
    if target.exact:
        target.book(sum(int(r["n_steps"].sum()) for r in reports))
    stats = stacked(reports[num_warmup:])
    z = np.asarray(stats.pop("z"))
    stats["tree_depth"] = np.ceil(np.log2(stats["n_steps"] + 1)).astype(int)
    return Chains(z, stats, target)


def draw(
    density: Density, seed: int, progress: Progress | None = None, *, num_samples: int = 1000, **options: Any
) -> Float[np.ndarray, "chain draw size"]:
    """Draws of any density, as `mismatch.belief.Sampler` asks for them; `options` are `fit`'s."""
    given = {"num_chains": 4, "num_warmup": 40, "target_accept": 0.8, "max_tree_depth": 8, "gradient": "auto"} | options
    with measured(density.problem) as cost:
        chains = sample(mode_at(density), as_key(seed), num_samples=num_samples, **given, cost=cost, progress=progress)
    return chains.z
