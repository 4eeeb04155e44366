"""Variational inference by NumPyro: an automatic guide about the mode's Gaussian, fitted by stochastic gradients.

Draws carry log target - log guide, so that their importance weights tell how close the guide came.
"""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density_jax import jax_log_prior
from det2stoc_bayes.errors import MethodNotApplicable
from det2stoc_bayes.inference._refine import Refine, Weighed, build_weighed, num_proposed
from det2stoc_bayes.inference._sampling import (
    NUM_CHAINS,
    Gradient,
    Target,
    advance,
    as_key,
    mode_of,
    numpy_random,
    per_chain,
    seed_of,
)
from det2stoc_bayes.posterior import DataTree, Progress, measured
from det2stoc_bayes.vector_density import AnyDensity, Inferred

Guide = Literal["full", "diagonal", "flow"]


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    guide: Guide = "full",
    num_steps: int = 300,
    num_particles: int = 16,
    learning_rate: float = 0.01,
    gradient: Gradient = "auto",
    refine: Refine = "none",
    progress: Progress | None = None,
) -> DataTree:
    """Draws of the guide: a Gaussian, one without correlations, or an inverse autoregressive flow.

    The learning rate falls as a cosine. `sample_stats.loss` is the negative ELBO of each step. `refine`: "psis"
    resamples by the exact likelihood.
    """
    from numpyro.infer import SVI, Trace_ELBO

    options = {
        "num_samples": num_samples,
        "guide": guide,
        "num_steps": num_steps,
        "num_particles": num_particles,
        "learning_rate": learning_rate,
        "gradient": gradient,
        "refine": refine,
    }
    each = num_proposed(per_chain(num_samples, NUM_CHAINS), refine)
    key = as_key(key)
    with measured(problem) as cost:
        mode = mode_of(problem)
        density, random = mode.density, numpy_random(key)
        target = Target(mode, random, gradient)
        scale = np.diag(1.0 / np.linalg.norm(np.linalg.inv(mode.scale), axis=0)) if guide == "diagonal" else mode.scale
        center, root, log_volume = jnp.asarray(mode.center), jnp.asarray(scale), np.linalg.slogdet(scale)[1]

        def log_density(u):
            z = center + root @ u
            return target.terms(z).sum() + jax_log_prior(z) + log_volume

        model = _model(log_density, density.size)
        fitted = _guide(guide, model, density)
        svi = SVI(model, fitted, _adam(learning_rate, num_steps), Trace_ELBO(num_particles))
        begin, draw = jax.random.split(key)
        state, losses = advance(svi.update, svi.init(begin), num_steps, cost, progress)
        if target.exact:
            target.book(num_steps * num_particles)
        u, log_guide = _draws(fitted, svi.get_params(state), draw, NUM_CHAINS * each)
        z = mode.center + u @ scale.T
        return build_weighed(
            density,
            Weighed.of(density, z, log_guide - log_volume),
            NUM_CHAINS,
            refine,
            random,
            sample_stats={"loss": (("step",), np.asarray(losses))},
            method="svi",
            options=options,
            seed=seed_of(key),
            cost=cost,
        )


def _model(log_density: Callable[[Any], Any], size: int) -> Callable[[], None]:
    """A NumPyro model whose joint density in u is exp(log_density)."""
    import numpyro
    import numpyro.distributions as dist

    def model() -> None:
        u = numpyro.sample("u", dist.ImproperUniform(dist.constraints.real_vector, (), (size,)))
        numpyro.factor("target", log_density(u))

    return model


def _guide(name: Guide, model: Callable[[], None], density: AnyDensity) -> Any:
    """NumPyro's guide of this kind, a Gaussian starting as the standard one."""
    from numpyro.infer import autoguide, init_to_value

    at_mode = init_to_value(values={"u": jnp.zeros(density.size)})
    if name == "flow":
        if density.size < 2:
            raise MethodNotApplicable("svi: guide 'flow' needs two unknowns; allowed for one: 'full', 'diagonal'")
        return autoguide.AutoIAFNormal(model, init_loc_fn=at_mode, num_flows=2, hidden_dims=[16, 16])
    family = autoguide.AutoDiagonalNormal if name == "diagonal" else autoguide.AutoMultivariateNormal
    return family(model, init_loc_fn=at_mode, init_scale=1.0)


def _adam(learning_rate: float, num_steps: int) -> Any:
    import optax
    from numpyro.optim import optax_to_numpyro

    return optax_to_numpyro(optax.adam(optax.cosine_decay_schedule(learning_rate, num_steps)))


def _draws(
    guide: Any, parameters: Any, key: jax.Array, num_draws: int
) -> tuple[Float[np.ndarray, "draws size"], Float[np.ndarray, " draws"]]:
    """Draws of a fitted guide, and their log density under it."""
    base, transform = guide.get_base_dist(), guide.get_transform(parameters)
    seed = base.sample(key, (num_draws,))
    u = jax.vmap(transform)(seed)
    log_density = base.log_prob(seed) - jax.vmap(transform.log_abs_det_jacobian)(seed, u)
    return np.asarray(u), np.asarray(log_density)
