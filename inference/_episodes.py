"""What a learned decoder says of whole episodes: each one's psi, and the population that they come from.

An episode's z has the reference prior N(0, I), which a population takes out again: it must not count once an episode.
"""

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
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
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
        return cls(cvae, *padded(x, y, episode))

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
            summits(self.cvae.decoder, start, *given) for start in (guess, jnp.zeros_like(guess))
        )
        first = one >= other
        z = jnp.where(first[:, None], z, z_other)
        return np.asarray(z, float), _inverse(np.asarray(jnp.where(first[:, None, None], fisher, fisher_other), float))


def padded(
    x: Float[np.ndarray, "rows x"], y: Float[np.ndarray, "rows y"], episode: Int[np.ndarray, " rows"]
) -> tuple[Float[Array, "episodes steps x"], Float[Array, "episodes steps y"], Float[Array, "episodes steps"]]:
    """Rows by episodes, in the order of their numbers, all as long as the longest; weight 0 marks padding."""
    names, of, counts = np.unique(episode, return_inverse=True, return_counts=True)
    order = np.argsort(of, kind="stable")
    step = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)
    out = []
    for rows in (x, y, np.ones((len(of), 1))):
        filled = np.zeros((len(names), counts.max(), rows.shape[1]), np.float32)
        filled[of[order], step] = rows[order]
        out.append(jnp.asarray(filled))
    return out[0], out[1], out[2][..., 0]


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

    def moments(z: Array) -> tuple[Array, Array]:
        return jax.vmap(decoder, (0, None))(x, z)

    _, scale = moments(z)
    slope, widening = jax.jacfwd(moments)(z)
    if scale.ndim == 2:
        white, relative = slope / scale[..., None], widening / scale[..., None]
        spread = 2 * jnp.einsum("t,tyi,tyj->ij", weight, relative, relative)
    else:
        white = jax.scipy.linalg.solve_triangular(scale, slope, lower=True)
        # tr(S^-1 dS S^-1 dS) / 2 of a covariance S = L L': its square root's change, seen from L
        root = jax.scipy.linalg.solve_triangular(scale[..., None, :, :], jnp.moveaxis(widening, -1, 1), lower=True)
        change = root + jnp.swapaxes(root, -1, -2)
        spread = 0.5 * jnp.einsum("t,tiab,tjab->ij", weight, change, change)
    return jnp.einsum("t,tyi,tyj->ij", weight, white, white) + spread + jnp.eye(len(z))


@eqx.filter_jit
def summits(
    decoder: Callable[..., Any], start: Array, x: Array, y: Array, weight: Array, steps: int = STEPS
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

        z, _ = jax.lax.scan(step, z, None, length=steps)
        return log_joint(decoder, z, x, y, weight), z, _fisher(decoder, z, x, weight)

    return jax.vmap(one)(start, x, y, weight)


def _inverse(fisher: Float[np.ndarray, "episodes z z"]) -> Float[np.ndarray, "episodes z z"]:
    """Covariances in double precision: information is at least the prior's, whatever single precision made of it."""
    values, vectors = np.linalg.eigh(0.5 * (fisher + np.swapaxes(fisher, 1, 2)))
    return np.einsum("eij,ej,ekj->eik", vectors, 1.0 / np.maximum(values, 1.0), vectors)


def population_draws(
    means: Float[np.ndarray, "episodes z"],
    covariances: Float[np.ndarray, "episodes z z"],
    key: PRNGKeyArray,
    num_draws: int = 1000,
    varies: Bool[np.ndarray, " z"] | None = None,
) -> tuple[Float[np.ndarray, "draws z"], Float[np.ndarray, "draws z"]]:
    """Posterior of the mean and sd of z over episodes, whose Gaussian posteriors under N(0, I) are given, by NUTS.

    Prior: mean N(0, 3), sd half-normal of 1, both in units of the last iteration's spread. Where z does not vary its
    sd is 0, and its mean is the one value that all episodes have.
    """
    varies = np.ones(means.shape[1], bool) if varies is None else varies
    score, information = evidence(means, covariances)
    with jax.enable_x64(True):
        chains = _population_chains(means.shape[1], num_draws, tuple(varies.tolist()))
        chains.run(key, jnp.asarray(score), jnp.asarray(information))
        draws = chains.get_samples()
    return np.asarray(draws["mu"], float), np.asarray(draws["spread"], float)


def evidence(
    means: Float[np.ndarray, "episodes z"], covariances: Float[np.ndarray, "episodes z z"]
) -> tuple[Float[np.ndarray, "episodes z"], Float[np.ndarray, "episodes z z"]]:
    """h and F of likelihoods exp(h'z - z'Fz / 2), from the Gaussian posteriors that they make of N(0, I)."""
    values, vectors = np.linalg.eigh(covariances)
    precision = 1.0 / np.clip(values, 1e-12, 1.0)
    information = np.einsum("eij,ej,ekj->eik", vectors, precision - 1.0, vectors)
    return np.einsum("eij,ej,ekj,ek->ei", vectors, precision, vectors, means), information


def log_marginal(mu: Array, spread: Array, score: Array, information: Array) -> Array:
    """log of the integral of N(z; mu, diag spread^2) exp(h'z - z'Fz / 2), for every episode; F may be singular."""
    off = score - information @ mu
    inner = jnp.eye(len(mu)) + spread[:, None] * information * spread
    root = jnp.linalg.cholesky(inner)
    white = jax.scipy.linalg.solve_triangular(root, (spread * off)[..., None], lower=True)[..., 0]
    log_det = jnp.log(jnp.diagonal(root, axis1=-2, axis2=-1)).sum(-1)
    return score @ mu - 0.5 * mu @ information @ mu - log_det + 0.5 * (white**2).sum(-1)


@cache  # compiled once for all iterations
def _population_chains(size: int, num_draws: int, varies: tuple[bool, ...]) -> MCMC:
    def model(score: Array, information: Array) -> None:
        mu = jnp.asarray(numpyro.sample("mu", dist.Normal(jnp.zeros(size), 3.0).to_event(1)))
        sigma = numpyro.sample("sigma", dist.HalfNormal(jnp.ones(size)).to_event(1))
        spread = jnp.where(jnp.array(varies), sigma, 0.0)
        numpyro.deterministic("spread", spread)
        numpyro.factor("episodes", log_marginal(mu, spread, score, information).sum())

    return MCMC(NUTS(model), num_warmup=500, num_samples=num_draws, progress_bar=False, jit_model_args=True)
