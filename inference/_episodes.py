"""What a learned decoder says of whole episodes: each one's psi, and the population that they come from."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float
from numpyro.infer import MCMC, NUTS

from det2stoc_bayes.inference._cvae import Cvae, normal

STEPS = 60
HALVINGS = 8


@dataclass(frozen=True, eq=False)
class Episodes:
    """Transitions of episodes, padded to one length; weight 0 marks padding."""

    cvae: Cvae
    x: Float[Array, "episodes steps x"]
    y: Float[Array, "episodes steps y"]
    weight: Float[Array, "episodes steps"]

    @classmethod
    def of(cls, cvae: Cvae, x: np.ndarray, y: np.ndarray, episode: np.ndarray) -> "Episodes":
        """Rows sorted into episodes."""
        names, counts = np.unique(episode, return_counts=True)
        shape = (len(names), counts.max())
        out = [np.zeros((*shape, x.shape[1]), np.float32), np.zeros((*shape, y.shape[1]), np.float32)]
        weight = np.zeros(shape, np.float32)
        for i, (name, count) in enumerate(zip(names, counts, strict=True)):
            rows = episode == name
            out[0][i, :count], out[1][i, :count], weight[i, :count] = x[rows], y[rows], 1.0
        return cls(cvae, jnp.asarray(out[0]), jnp.asarray(out[1]), jnp.asarray(weight))

    def amortized(self) -> tuple[Float[Array, "episodes z"], Float[Array, "episodes z"]]:
        """Means and sds of the product of the transitions' evidence q / prior with one prior."""
        mean, scale = jax.vmap(jax.vmap(self.cvae.encoder))(self.x, self.y)
        sd = scale if scale.ndim == mean.ndim else jnp.sqrt((scale**2).sum(-1))  # of q's margins
        own = self.weight[..., None] * jnp.maximum(sd**-2 - 1.0, 0.0)
        precision = 1.0 + own.sum(1)
        return (self.weight[..., None] * mean * sd**-2).sum(1) / precision, precision**-0.5

    def posteriors(self) -> tuple[Float[np.ndarray, "episodes z"], Float[np.ndarray, "episodes z z"]]:
        """Laplace's approximation to each episode's posterior under the decoder, by Fisher scoring."""
        # A network's valleys have several bottoms: from the encoder's guess and from the prior's centre, the deeper.
        guess, _ = self.amortized()
        given = (self.x, self.y, self.weight)
        (one, z, fisher), (other, z_other, fisher_other) = (
            _summits(self.cvae.decoder, start, *given) for start in (guess, jnp.zeros_like(guess))
        )
        first = one >= other
        z = jnp.where(first[:, None], z, z_other)
        return np.asarray(z, float), _inverse(np.asarray(jnp.where(first[:, None, None], fisher, fisher_other), float))


def log_joint(
    decoder: Callable[..., Any],
    z: Float[Array, " z"],
    x: Float[Array, "steps x"],
    y: Float[Array, "steps y"],
    weight: Float[Array, " steps"],
) -> Float[Array, ""]:
    """log p(y | x, z) N(z; 0, I) of one episode, one z for all of its transitions."""
    mean, scale = jax.vmap(decoder, (0, None))(x, z)
    return (weight * normal(mean, scale).log_prob(y)).sum() - 0.5 * (z**2).sum()


def _fisher(decoder: Callable[..., Any], z: Array, x: Array, weight: Array) -> Float[Array, "z z"]:
    """Expected information about an episode's z, the prior's included."""

    def natural(z: Array) -> tuple[Array, Array, Array]:
        mean, scale = jax.vmap(decoder, (0, None))(x, z)
        return mean, jnp.log(scale) if scale.ndim == mean.ndim else scale, scale

    _, _, scale = natural(z)
    slope, widening, _ = jax.jacfwd(natural)(z)
    if scale.ndim == 2:
        white = slope / scale[..., None]
    else:
        white, widening = jax.scipy.linalg.solve_triangular(scale, slope, lower=True), jnp.zeros_like(slope)
    total = jnp.einsum("t,tyi,tyj->ij", weight, white, white)
    return total + 2 * jnp.einsum("t,tyi,tyj->ij", weight, widening, widening) + jnp.eye(len(z))


@eqx.filter_jit
def _summits(
    decoder: Callable[..., Any], start: Array, x: Array, y: Array, weight: Array
) -> tuple[Array, Array, Array]:
    """Height, place and information of each episode's summit, climbed from a start."""

    def one(z: Array, x: Array, y: Array, weight: Array) -> tuple[Array, Array, Array]:
        def step(z: Array, _: None) -> tuple[Array, None]:
            value, slope = jax.value_and_grad(lambda z: log_joint(decoder, z, x, y, weight))(z)
            move = jnp.linalg.solve(_fisher(decoder, z, x, weight), slope).astype(z.dtype)
            tried = z + move * 0.5 ** jnp.arange(HALVINGS, dtype=z.dtype)[:, None]
            values = jax.vmap(lambda t: log_joint(decoder, t, x, y, weight))(tried)
            best = jnp.argmax(jnp.where(jnp.isfinite(values), values, -jnp.inf))
            return jnp.where(values[best] > value, tried[best], z), None

        z, _ = jax.lax.scan(step, z, None, length=STEPS)
        return log_joint(decoder, z, x, y, weight), z, _fisher(decoder, z, x, weight)

    return jax.vmap(one)(start, x, y, weight)


def _inverse(fisher: Float[np.ndarray, "episodes z z"]) -> Float[np.ndarray, "episodes z z"]:
    """Covariances in double precision: information is at least the prior's, whatever single precision made of it."""
    values, vectors = np.linalg.eigh(0.5 * (fisher + np.swapaxes(fisher, 1, 2)))
    return np.einsum("eij,ej,ekj->eik", vectors, 1.0 / np.maximum(values, 1.0), vectors)


def population_draws(
    means: Float[np.ndarray, "episodes z"], covariances: Float[np.ndarray, "episodes z z"], key, num_draws: int = 1000
) -> tuple[Float[np.ndarray, "draws z"], Float[np.ndarray, "draws z"]]:
    """Posterior of the mean and sd of z over episodes, each known as a Gaussian, by NUTS.

    Prior: mean N(0, 3), sd half-normal of 1, both in units of the last iteration's spread.
    """
    chains = _population_chains(means.shape[1], num_draws)
    chains.run(key, jnp.asarray(means), jnp.asarray(covariances))
    draws = chains.get_samples()
    return np.asarray(draws["mu"], float), np.asarray(draws["sigma"], float)


@cache  # compiled once for all iterations
def _population_chains(size: int, num_draws: int) -> MCMC:
    def model(means: Array, covariances: Array) -> None:
        mu = numpyro.sample("mu", dist.Normal(jnp.zeros(size), 3.0).to_event(1))
        sigma = numpyro.sample("sigma", dist.HalfNormal(jnp.ones(size)).to_event(1))
        total = covariances + jnp.eye(size) * (sigma**2 + 1e-8)
        with numpyro.plate("episodes", len(means)):
            numpyro.sample("z", dist.MultivariateNormal(mu, total), obs=means)

    return MCMC(NUTS(model), num_warmup=500, num_samples=num_draws, progress_bar=False, jit_model_args=True)
