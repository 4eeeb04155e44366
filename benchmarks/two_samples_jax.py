"""The classifier two-sample test of `two_samples`, its folds and many pairs side by side: the same network, faster.

What scikit-learn's MLPClassifier does with its default settings is done here as one compiled loop (Glorot's uniform
first weights, Adam, batches of 200, L2 penalty 1e-4, until the training loss has not fallen by 1e-4 in ten epochs).
Only the random numbers differ.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from det2stoc_bayes.psis import thinned
from det2stoc_bayes.two_samples import WIDTH, Draws

BATCH, PENALTY, RATE = 200, 1e-4, 1e-3
TOLERANCE, PATIENCE, MOST_EPOCHS = 1e-4, 10, 10_000


def c2st(draws: Draws, reference: Draws, *, seed: int = 1, num_folds: int = 5) -> float:
    """As `two_samples.c2st`. Folds are equally large: of each set as many draws as that asks for."""
    return float(c2sts(draws[None], reference[None], seed=seed, num_folds=num_folds)[0])


def c2sts(
    draws: Float[np.ndarray, "pairs draws size"],
    reference: Float[np.ndarray, "pairs others size"],
    *,
    seed: int = 1,
    num_folds: int = 5,
) -> Float[np.ndarray, " pairs"]:
    """`c2st` of many pairs, all at once."""
    count = min(draws.shape[1], reference.shape[1]) // num_folds * num_folds
    center, scale = draws.mean(1, keepdims=True), draws.std(1, ddof=1, keepdims=True)
    scale = np.where(scale > 0, scale, 1.0)
    both = [np.concatenate([thinned(a, count), thinned(b, count)]) for a, b in zip(draws, reference, strict=True)]
    label = np.repeat(np.array([0, 1], np.float32), count)
    order = np.random.default_rng(seed).permutation(2 * count).reshape(num_folds, -1)
    others = np.stack([np.delete(order, k, axis=0).ravel() for k in range(num_folds)])
    with jax.enable_x64(False):
        keys = jax.random.split(jax.random.key(seed), num_folds)
        x, y = jnp.asarray((np.stack(both) - center) / scale, jnp.float32), jnp.asarray(label)
        first, batch = _begin(keys, draws.shape[2]), min(BATCH, others.shape[1])
        state = jax.tree.map(lambda a: jnp.repeat(a[None], len(x), 0), first)
        for epoch in range(MOST_EPOCHS):
            state = _epoch(state, x, y, jnp.asarray(others), jax.random.fold_in(keys[0], epoch), batch)
            if bool((state[3] > PATIENCE).all()):
                break
        told = np.asarray(_logits_of_folds(state[0], x[:, jnp.asarray(order)])) > 0
    return (told == label[order]).mean(2).mean(1)


def _begin(keys: jax.Array, size: int) -> Any:
    """Weights, Adam's memory, least loss and the epochs since, of each fold."""
    sizes = [size, WIDTH * size, WIDTH * size, 1]

    def one(key: jax.Array) -> Any:
        layers = []
        for k, a, b in zip(jax.random.split(key, 3), sizes[:-1], sizes[1:], strict=True):
            bound = np.sqrt((2.0 if b == 1 else 6.0) / (a + b))  # 2 below a logistic output
            weights = jax.random.uniform(k, (a + 1, b), jnp.float32, -bound, bound)
            layers.append((weights[:-1], weights[-1]))
        return layers, optax.adam(RATE).init(layers), jnp.float32(jnp.inf), jnp.int32(0)

    return jax.vmap(one)(keys)


def _logits(layers: Any, x: Float[Array, "rows size"]) -> Float[Array, " rows"]:
    for weights, bias in layers[:-1]:
        x = jax.nn.relu(x @ weights + bias)
    weights, bias = layers[-1]
    return (x @ weights + bias)[:, 0]


_logits_of_folds = jax.jit(jax.vmap(jax.vmap(_logits)))


def _loss(layers: Any, x: Array, y: Array) -> Array:
    penalty = 0.5 * PENALTY * sum((weights**2).sum() for weights, _ in layers) / len(x)
    return optax.sigmoid_binary_cross_entropy(_logits(layers, x), y).mean() + penalty


@partial(jax.jit, static_argnames="batch")
def _epoch(state: Any, x: Array, y: Array, rows: Array, key: jax.Array, batch: int) -> Any:
    """Every fold of every pair sees its rows once, in its own order; those that have finished stay as they are."""

    def one(state: Any, x: Array, rows: Array, key: jax.Array) -> Any:
        layers, memory, least, since = state
        batches = jax.random.permutation(key, rows)[: len(rows) // batch * batch].reshape(-1, batch)

        def step(carry: Any, now: Array) -> Any:
            layers, memory = carry
            loss, gradient = jax.value_and_grad(_loss)(layers, x[now], y[now])
            change, memory = optax.adam(RATE).update(gradient, memory)
            return (optax.apply_updates(layers, change), memory), loss

        (layers, memory), losses = jax.lax.scan(step, (layers, memory), batches)
        since = jnp.where(losses.mean() > least - TOLERANCE, since + 1, 0)
        new = layers, memory, jnp.minimum(least, losses.mean()), since
        return jax.tree.map(lambda a, b: jnp.where(state[3] > PATIENCE, a, b), state, new)

    folds = jax.vmap(one, in_axes=(0, None, 0, 0))
    return jax.vmap(folds, in_axes=(0, 0, None, None))(state, x, rows, jax.random.split(key, len(rows)))
