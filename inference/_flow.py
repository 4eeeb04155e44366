"""p(theta | x) as an ensemble of masked autoregressive spline flows, learned from pairs of theta and x.

Neural posterior estimation (Papamakarios and Murray 2016) with the flows of Durkan et al. (2019): plain arrays in and
out. What is linear is found first (the regression adjustment of Beaumont et al. 2002): the flows tell what a linear
regression of theta on x leaves, in units in which it is white. Members differ in their first weights and in the order
of their batches; their mixture is the density.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import paramax
from flowjax.bijections import RationalQuadraticSpline
from flowjax.distributions import StandardNormal
from flowjax.flows import masked_autoregressive_flow
from jaxtyping import Array, Float

from det2stoc_bayes.errors import SamplingFailed

Progress = Callable[[int, int], None]
ROWS = 10_000  # at a time: splines of all knots are held
CLIP = 5.0  # of a gradient's norm
FARTHEST = 20.0  # standardised x: what lies beyond says no more
FEWEST = 50  # pairs
RIDGE = 1e-6  # pairs' worth
LEAST_LEFT = 1e-6  # sds of theta that a line leaves at least


@dataclass(frozen=True)
class Training:
    """Sizes and schedule. `batch`: pairs a step, of many simulations more, so that an epoch has `num_steps` at most.

    The weights that are judged and kept are a running mean over about 1 / (1 - `smoothing`) steps. A member has
    finished when the validation loss has not improved for `patience` epochs.
    """

    num_members: int = 4
    num_layers: int = 5
    width: int = 64
    depth: int = 2
    knots: int = 8
    interval: float = 5.0
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    batch: int = 50
    num_steps: int = 100
    smoothing: float = 0.99
    validation: float = 0.1
    patience: int = 20
    num_epochs: int = 500


@dataclass(frozen=True, eq=False)
class ConditionalFlow:
    """A learned p(theta | x); pickled as its arrays alone, since flows hold local functions."""

    members: Any  # flows, their arrays stacked
    training: Training
    center: Float[np.ndarray, " features"]
    scale: Float[np.ndarray, " features"]
    line: Float[np.ndarray, "features_and_one size"]  # of theta by standardised x and 1
    root: Float[np.ndarray, "size size"]  # lower triangular: theta = line + root @ what the flows tell
    history: Float[np.ndarray, "epochs members"]  # validation loss [nat]

    def __reduce__(self) -> tuple[Any, ...]:
        arrays = [np.asarray(a) for a in jax.tree.leaves(eqx.filter(self.members, eqx.is_array))]
        return _restored, (arrays, self.training, self.center, self.scale, self.line, self.root, self.history)

    def log_density(
        self, theta: Float[np.ndarray, "rows size"], x: Float[np.ndarray, " features"]
    ) -> Float[np.ndarray, " rows"]:
        """log p(theta | x) of the mixture."""
        given = _standardised(x, self.center, self.scale)
        left = np.linalg.solve(self.root, (theta - _with_one(given) @ self.line).T).T
        with jax.enable_x64(False):
            found = [np.asarray(_log_density(self.members, part, jnp.asarray(given)), float) for part in _parts(left)]
        return np.concatenate(found) - np.log(np.diag(self.root)).sum()

    def sample(self, key: jax.Array, x: Float[np.ndarray, " features"], count: int) -> Float[np.ndarray, "count size"]:
        """Draws of theta, as many of each member, in random order."""
        given = _standardised(x, self.center, self.scale)
        with jax.enable_x64(False):
            num_members = self.history.shape[1]
            draw, mix = jax.random.split(key)
            each, found = -(-count // num_members), []
            for k, begin in enumerate(range(0, each, ROWS)):
                keys = jax.random.split(jax.random.fold_in(draw, k), num_members)
                drawn = _sample(self.members, keys, jnp.asarray(given), min(ROWS, each))
                found.append(np.asarray(drawn, float)[:, : each - begin])
            left = np.concatenate(found, 1).reshape(-1, len(self.root))
            left = left[np.asarray(jax.random.permutation(mix, len(left)))[:count]]
        return _with_one(given) @ self.line + left @ self.root.T


def train(
    theta: Float[np.ndarray, "sims size"],
    x: Float[np.ndarray, "sims features"],
    key: jax.Array,
    options: Training = Training(),
    *,
    noise: float = 0.0,
    progress: Progress = lambda *_: None,
) -> ConditionalFlow:
    """The flows of least validation loss. `noise`: sd of what is added to x anew in every step, in x's units.

    SamplingFailed: fewer than FEWEST pairs, or no finite loss.
    """
    if len(theta) < FEWEST:
        raise SamplingFailed(f"a flow was to learn from {len(theta)} simulations; allowed: {FEWEST} at least")
    center, scale = x.mean(0), np.sqrt(x.var(0) + noise**2)
    scale = np.where(scale > 0, scale, 1.0)
    with jax.enable_x64(False):
        first, split, learn = jax.random.split(key, 3)
        order = np.asarray(jax.random.permutation(split, len(theta)))
        held = max(int(options.validation * len(theta)), 1)
        given = _standardised(x, center, scale)
        blur = noise / scale
        line, root = _regression(given[order[held:]], theta[order[held:]], blur)
        left = np.linalg.solve(root, (theta - _with_one(given) @ line).T).T.astype(np.float32)
        pairs = left, given
        seen, judged = ([jnp.asarray(a[rows]) for a in pairs] for rows in (order[held:], order[:held]))
        members = _members(first, theta.shape[1], x.shape[1], options)
        carried = np.linalg.solve(root, (blur[:, None] * line[:-1]).T).T  # how noise moves what the line leaves
        spread = (jnp.asarray(blur, jnp.float32), jnp.asarray(carried, jnp.float32)) if noise else None
        members, history = _optimize(members, seen, judged, learn, options, spread, progress)
    return ConditionalFlow(members, options, center, scale, line, root, history)


def _members(key: jax.Array, size: int, features: int, options: Training) -> Any:
    make = eqx.filter_vmap(lambda k: _flow(k, size, features, options))
    return make(jax.random.split(key, options.num_members))


@cache  # the same functions again: what was compiled for one flow serves others of its form
def _form(size: int, features: int, options: Training) -> tuple[Any, Any]:
    """How members' arrays are arranged, and all that is no array."""
    with jax.enable_x64(False):  # made in earnest: the functions hold numbers
        arrays, rest = eqx.partition(_members(jax.random.key(0), size, features, options), eqx.is_array)
    return jax.tree.structure(arrays), rest


def _restored(arrays: list[np.ndarray], options: Training, center: np.ndarray, *others: np.ndarray) -> ConditionalFlow:
    """A flow that was pickled."""
    root = others[2]
    arranged, rest = _form(len(root), len(center), options)
    with jax.enable_x64(False):
        members = eqx.combine(jax.tree.unflatten(arranged, [jnp.asarray(a) for a in arrays]), rest)
    return ConditionalFlow(members, options, center, *others)


def _flow(key: jax.Array, size: int, features: int, options: Training) -> Any:
    return masked_autoregressive_flow(
        key,
        base_dist=StandardNormal((size,)),
        transformer=RationalQuadraticSpline(knots=options.knots, interval=options.interval),
        cond_dim=features,
        flow_layers=options.num_layers,
        nn_width=options.width,
        nn_depth=options.depth,
        nn_activation=jax.nn.silu,
    )


def _optimize(
    members: Any,
    seen: list[Array],
    judged: list[Array],
    key: jax.Array,
    options: Training,
    spread: tuple[Array, Array] | None,
    progress: Progress,
) -> tuple[Any, Float[np.ndarray, "epochs members"]]:
    """Adam with decoupled weight decay, each member by itself; the running mean of the weights is judged."""
    learned, fixed = eqx.partition(
        members, eqx.is_inexact_array, is_leaf=lambda leaf: isinstance(leaf, paramax.NonTrainable)
    )
    arrays, static = eqx.partition(fixed, eqx.is_array)  # each member has its own permutations
    count = len(seen[0])
    batch = min(max(options.batch, count // options.num_steps), count)
    optimizer = optax.chain(
        optax.clip_by_global_norm(CLIP), optax.adamw(options.learning_rate, weight_decay=options.weight_decay)
    )

    def loss(weights, own, theta, x):
        return -eqx.combine(weights, eqx.combine(own, static)).log_prob(theta, x).mean()

    def step(own, state, now):
        weights, mean, memory, done = state
        rows, k = now
        theta, x = (a[rows] for a in seen)
        theta, x = _blurred(theta, x, spread, k)
        gradient = jax.grad(loss)(weights, own, theta, x)
        change, memory = optimizer.update(gradient, memory, weights)
        weights = optax.apply_updates(weights, change)
        share = jnp.minimum(options.smoothing, done / (done + 10.0))  # the first weights are soon forgotten
        mean = jax.tree.map(lambda m, w: share * m + (1 - share) * w, mean, weights)
        return (weights, mean, memory, done + 1.0), None

    def epoch(own, state, best, k):
        mix, blur = jax.random.split(k)
        rows = jax.random.permutation(mix, count)[: count // batch * batch].reshape(-1, batch)
        state, _ = jax.lax.scan(partial(step, own), state, (rows, jax.random.split(blur, len(rows))))
        value = loss(state[1], own, *judged)
        better = value < best[0]  # a loss that is no number is none
        return state, jax.tree.map(lambda new, old: jnp.where(better, new, old), (value, state[1]), best), value

    learned = jax.tree.map(lambda a: jax.lax.convert_element_type(a, a.dtype), learned)  # a weak type compiles anew
    begin = jax.vmap(lambda w: (w, w, optimizer.init(w), jnp.float32(0.0)))
    state, best = begin(learned), (jnp.full(options.num_members, jnp.inf, jnp.float32), learned)
    advance, history = jax.jit(jax.vmap(epoch)), []
    since = np.zeros(options.num_members, int)
    judged = [*_blurred(judged[0], judged[1], spread, jax.random.fold_in(key, 0))]
    for i in range(options.num_epochs):
        before = np.asarray(best[0])
        keys = jax.random.split(jax.random.fold_in(key, i + 1), options.num_members)
        state, best, value = advance(arrays, state, best, keys)
        since = np.where(np.asarray(best[0]) < before, 0, since + 1)
        history.append(np.asarray(value, float))
        progress(i + 1, options.num_epochs)
        if (since >= options.patience).all():
            break
    if not np.isfinite(best[0]).all():
        raise SamplingFailed(
            f"a flow came to no finite loss in {len(history)} epochs; allowed: data of moderate size, "
            "or a lower learning rate"
        )
    return eqx.combine(best[1], fixed), np.stack(history)


def _blurred(theta: Array, x: Array, spread: tuple[Array, Array] | None, key: jax.Array) -> tuple[Array, Array]:
    """x with noise, and theta's distance from the line at it."""
    if spread is None:
        return theta, x
    noise = jax.random.normal(key, x.shape, x.dtype)
    return theta - noise @ spread[1], x + noise * spread[0]


def _standardised(x: np.ndarray, center: np.ndarray, scale: np.ndarray) -> Float[np.ndarray, "..."]:
    return np.clip((x - center) / scale, -FARTHEST, FARTHEST).astype(np.float32)


def _with_one(x: np.ndarray) -> Float[np.ndarray, "*rows features_and_one"]:
    return np.concatenate([x, np.ones((*x.shape[:-1], 1))], -1).astype(float)


def _regression(
    x: Float[np.ndarray, "sims features"], theta: Float[np.ndarray, "sims size"], blur: Float[np.ndarray, " features"]
) -> tuple[Float[np.ndarray, "features_and_one size"], Float[np.ndarray, "size size"]]:
    """Least squares under noise of sd `blur` in x, a slight ridge, and the Cholesky factor of what is left."""
    design, count = _with_one(x), len(x)
    noise = np.diag(np.append(blur, 0.0)) ** 2
    gram = design.T @ design + count * noise
    line = np.linalg.solve(gram + RIDGE * np.eye(len(gram)), design.T @ theta)
    left = theta - design @ line
    covariance = left.T @ left / count + line.T @ noise @ line
    return line, np.linalg.cholesky(covariance + LEAST_LEFT**2 * np.eye(theta.shape[1]))


def _parts(theta: Float[np.ndarray, "rows size"]) -> Iterator[Array]:
    for begin in range(0, len(theta), ROWS):
        yield jnp.asarray(theta[begin : begin + ROWS], jnp.float32)


@eqx.filter_jit
def _log_density(members: Any, theta: Array, x: Array) -> Array:
    terms = eqx.filter_vmap(lambda flow: flow.log_prob(theta, x), in_axes=eqx.if_array(0))(members)
    return jax.nn.logsumexp(terms, axis=0) - jnp.log(terms.shape[0])


@eqx.filter_jit
def _sample(members: Any, keys: jax.Array, x: Array, count: int) -> Array:
    return eqx.filter_vmap(lambda flow, key: flow.sample(key, (count,), x), in_axes=(eqx.if_array(0), 0))(members, keys)
