"""q(z | episode) learned from simulated episodes: neural posterior estimation over sets of transitions.

A transition adds its evidence about z to the prior N(0, I); what the sum is worth is learned of whole episodes, while
a decoder's likelihood multiplies over an episode what it misses in every transition.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float, PRNGKeyArray
from numpyro.contrib.module import eqx_module
from numpyro.infer import Trace_ELBO

from det2stoc_bayes.inference._cvae import Schedule, held_back, optimize
from det2stoc_bayes.inference._episodes import padded
from det2stoc_bayes.inference._networks import SkipMLP
from det2stoc_bayes.transitions import Scaling, Transitions

WIDTH, DEPTH, DROPOUT = 128, 2, 0.2
FIRST_SCALE = 0.1  # of a transition's evidence before training


class EpisodeEncoder(eqx.Module):
    """Mean and precision of z, from an episode's transitions in whatever order (deep sets: Zaheer et al. 2017)."""

    net: SkipMLP
    dropout: eqx.nn.Dropout
    size: int = eqx.field(static=True)

    def __init__(self, x: int, y: int, z: int, key: PRNGKeyArray):
        self.size, self.dropout = z, eqx.nn.Dropout(DROPOUT)
        self.net = SkipMLP(x + y, 0, z + z * (z + 1) // 2, key, width=WIDTH, depth=DEPTH, norm=False)

    def __call__(
        self,
        x: Float[Array, "steps x"],
        y: Float[Array, "steps y"],
        weight: Float[Array, " steps"],
        key: PRNGKeyArray | None = None,
    ) -> tuple[Float[Array, " z"], Float[Array, "z z"]]:
        given = self.dropout(jnp.concatenate([x, y], 1), key=key, inference=key is None)
        told = FIRST_SCALE * jax.vmap(lambda row: self.net(row, jnp.zeros(0, row.dtype)))(given)
        score, below = told[:, : self.size], jnp.zeros((len(x), self.size, self.size), told.dtype)
        below = below.at[:, *jnp.tril_indices(self.size)].set(told[:, self.size :])
        precision = jnp.eye(self.size, dtype=told.dtype) + jnp.einsum("t,tij,tkj->ik", weight, below, below)
        return jnp.linalg.solve(precision, weight @ score), precision


def episode_posteriors(
    real: Transitions,
    simulated: Transitions,
    z: Float[np.ndarray, "rows z"],
    scaling: Scaling,
    key: PRNGKeyArray,
    schedule: Schedule,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> tuple[Float[np.ndarray, "episodes z"], Float[np.ndarray, "episodes z z"], list[tuple[int, float, float]]]:
    """Means and covariances of recorded episodes' z under N(0, I), and the history of (step, loss, validation loss).

    The encoder learns from simulated episodes, whose z are given row by row. SamplingFailed: no finite loss.
    """
    first, split, train = jax.random.split(key, 3)
    _, begins = np.unique(simulated.episode, return_index=True)
    true = jnp.asarray(z[begins], jnp.float32)
    known = (*padded(*scaling.standard(simulated), simulated.episode), true)
    shown, judged = ([a[rows] for a in known] for rows in held_back(split, len(begins)))
    encoder = EpisodeEncoder(known[0].shape[-1], known[1].shape[-1], true.shape[1], first)
    params, history = optimize(
        Trace_ELBO(), partial(_model, encoder), lambda *_: None, shown, judged, train, schedule, progress=progress
    )
    learned = eqx.combine(params["encoder$params"], encoder)
    means, precisions = jax.jit(jax.vmap(learned))(*padded(*scaling.standard(real), real.episode))
    return np.asarray(means, float), np.linalg.inv(np.asarray(precisions, float)), history


def _model(encoder: EpisodeEncoder, x: Array, y: Array, weight: Array, z: Array) -> None:
    """z of simulated episodes, as observed."""
    learned: Any = eqx_module("encoder", encoder)
    key = numpyro.prng_key()
    keys = None if key is None else jax.random.split(key, x.shape[0])
    with numpyro.plate("episodes", x.shape[0]):
        mean, precision = jax.vmap(learned, (0, 0, 0, None if keys is None else 0))(x, y, weight, keys)
        numpyro.sample("z", dist.MultivariateNormal(mean, precision_matrix=precision), obs=z)
