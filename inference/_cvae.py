"""A conditional VAE as a NumPyro model and guide, and how its two networks are trained.

Model: z ~ prior, y | x, z ~ N(decoder(x, z)). Guide: z | x, y ~ N(encoder(x, y)). x is state and action, y the change
of the state, all standardised.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from numpyro.contrib.module import eqx_module
from numpyro.handlers import seed, substitute, trace
from numpyro.infer import SVI, Trace_ELBO

from det2stoc_bayes.errors import SamplingFailed
from det2stoc_bayes.inference._latent import LatentMixture

Batch = Float[Array, "_ _"]
VALIDATION = 0.2  # share of episodes that training does not see


def normal(mean: Float[Array, "*b size"], scale: Float[Array, "..."]) -> dist.Distribution:
    """A Gaussian with a diagonal or a lower-triangular scale."""
    if scale.ndim > mean.ndim:
        return dist.MultivariateNormal(mean, scale_tril=scale)
    return dist.Normal(mean, scale).to_event(1)


def standard_normal(size: int) -> dist.Distribution:
    """The prior of z, in single precision."""
    return dist.Normal(jnp.zeros(size, jnp.float32), 1.0).to_event(1)


def _learned(name: str, network: Any) -> Any:
    """The network with weights of NumPyro's."""
    return eqx_module(name, network)


@dataclass(frozen=True)
class Cvae[Generator: Callable[..., Any]]:
    """Networks and prior of a CVAE. `decoder_frozen`: the model holds it as it is and learns none of it."""

    encoder: Callable[..., Any]  # (x, y, key) -> mean and scale of z
    decoder: Generator  # (x, z) -> mean and scale of y
    prior: dist.Distribution | LatentMixture  # a mixture is learned
    decoder_frozen: bool

    def with_params(self, params: Mapping[str, Any]) -> Self:
        """The same with trained networks."""
        names = [n for n in ("encoder", "decoder", "prior") if f"{n}$params" in params]
        return replace(self, **{n: eqx.combine(params[f"{n}$params"], getattr(self, n)) for n in names})

    def model(self, x: Batch, y: Batch | None = None, z: Batch | None = None) -> None:
        """The generative side; with z given, the regression that trains the decoder on simulations."""
        decoder = self.decoder if self.decoder_frozen else _learned("decoder", self.decoder)
        prior = _learned("prior", self.prior)() if isinstance(self.prior, LatentMixture) else self.prior
        with numpyro.plate("transitions", x.shape[0]):
            z = jnp.asarray(numpyro.sample("z", prior)) if z is None else z
            numpyro.sample("y", normal(*jax.vmap(decoder)(x, z)), obs=y)

    def guide(self, x: Batch, y: Batch, z: Batch | None = None) -> None:
        """The recognition side; nothing where z is given."""
        if z is not None:
            return
        encoder, keys = _learned("encoder", self.encoder), numpyro.prng_key()
        keys = None if keys is None else jax.random.split(keys, x.shape[0])
        with numpyro.plate("transitions", x.shape[0]):
            mean, scale = jax.vmap(encoder, (0, 0, None if keys is None else 0))(x, y, keys)
            numpyro.sample("z", normal(mean, scale))


class HybridELBO(Trace_ELBO):
    """alpha ELBO + (1 - alpha) E over the prior of log p(y | x, z) (Sohn et al. 2015, eq. 6), as a loss."""

    def __init__(self, alpha: float, num_particles: int = 1):
        self.alpha = alpha
        super().__init__(num_particles)

    def loss_with_mutable_state(self, rng_key, param_map, model, guide, *args, **kwargs):
        own, other = jax.random.split(rng_key)
        result = super().loss_with_mutable_state(own, param_map, model, guide, *args, **kwargs)
        if self.alpha == 1:  # what counts for nothing would cost a backward pass
            return result
        generated = trace(substitute(seed(model, other), data=param_map)).get_trace(*args, **kwargs)
        site = generated["y"]
        loss = jnp.asarray(result["loss"])  # of several parts only where a module has more losses than one
        result["loss"] = self.alpha * loss - (1 - self.alpha) * site["fn"].log_prob(site["value"]).sum()
        return result


@dataclass(frozen=True)
class Schedule:
    """Adam with a cosine learning rate, the validation loss being looked at `checks` times.

    Training ends when it has not improved for `patience / checks` of all steps. Few rows are soon learned by heart: of
    them it is looked at more often, every so many `epochs`.
    """

    num_steps: int
    learning_rate: float = 1e-3
    batch: int = 512
    checks: int = 40
    patience: int = 8
    epochs: float = 10.0

    def steps_between_checks(self, num_rows: int) -> int:
        """One at least."""
        often = self.epochs * num_rows / min(self.batch, num_rows)
        return max(int(min(self.num_steps // self.checks, often)), 1)


def held_back(key: PRNGKeyArray, count: int) -> tuple[Int[np.ndarray, " shown"], Int[np.ndarray, " held"]]:
    """Of so many episodes, in random order, those to learn from and those to judge by."""
    order = np.asarray(jax.random.permutation(key, count))
    held = max(int(VALIDATION * count), 1)
    return order[held:], order[:held]


def optimize(
    elbo: Any,
    model: Callable,
    guide: Callable,
    data: Sequence[Float[Array, "_ ..."]],
    validation: Sequence[Float[Array, "_ ..."]],
    key: PRNGKeyArray,
    schedule: Schedule,
    *,
    init: Mapping[str, Any] | None = None,
    keep: Callable[[int, Mapping[str, Any]], None] = lambda *_: None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> tuple[dict[str, Any], list[tuple[int, float, float]]]:
    """The parameters with the least validation loss, and (step, training loss, validation loss) a row."""
    count = data[0].shape[0]
    size = min(schedule.batch, count)
    chunk = schedule.steps_between_checks(count)
    checks = max(schedule.num_steps // chunk, 1)
    steps = checks * chunk
    patience = max(round(schedule.patience * checks / schedule.checks), 1)
    optimizer = optax.chain(
        optax.clip_by_global_norm(10.0 * size), optax.adam(optax.cosine_decay_schedule(schedule.learning_rate, steps))
    )
    svi = SVI(model, guide, optimizer, elbo)
    begin, check, key = jax.random.split(key, 3)
    state = svi.init(begin, *(d[:size] for d in data), init_params=init)

    @jax.jit
    def advance(state, key):
        def one(state, key):
            rows = jax.random.randint(key, (size,), 0, count)
            return svi.update(state, *(d[rows] for d in data))

        state, losses = jax.lax.scan(one, state, jax.random.split(key, chunk))
        return state, losses.mean() / size

    @jax.jit
    def judge(state):
        return elbo.loss(check, svi.get_params(state), model, guide, *validation) / validation[0].shape[0]

    best, params, since, history = jnp.inf, svi.get_params(state), 0, []
    for i in range(checks):
        key, now = jax.random.split(key)
        state, loss = advance(state, now)
        value = float(judge(state))
        history.append(((i + 1) * chunk, float(loss), value))
        keep((i + 1) * chunk, svi.get_params(state))
        progress(i + 1, checks)
        if value < best:
            best, params, since = value, svi.get_params(state), 0
        else:
            since += 1
            if since >= patience:
                break
    if not np.isfinite(best):
        raise SamplingFailed(
            f"training came to no finite loss in {len(history)} checks ({history[-1][0]} steps, last loss "
            f"{history[-1][2]:g}); allowed: data of moderate size, or a lower learning rate"
        )
    return params, history
