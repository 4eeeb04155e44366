"""Conditional Gaussians as networks: layers of SiLU with layer norm, into every one of which the latent is fed anew."""

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

FIRST_PUSH = 0.3  # sds of the outputs
LOG_SD = (-10.0, 4.0)  # of standardised outputs: how sure a network can be


class SkipMLP(eqx.Module):
    """A perceptron whose every layer sees `skip` beside the layer before."""

    layers: tuple[eqx.nn.Linear, ...]
    norms: tuple[eqx.nn.LayerNorm, ...]
    last: eqx.nn.Linear
    activation: Callable = eqx.field(static=True)

    def __init__(
        self,
        size: int,
        skip: int,
        out: int,
        key: PRNGKeyArray,
        *,
        width: int = 64,
        depth: int = 3,
        activation: Callable = jax.nn.silu,
        norm: bool = True,
    ):
        keys, kind = jax.random.split(key, depth + 1), jnp.float32
        sizes = [size, *[width] * depth]
        pairs = zip(sizes[:-1], keys[:-1], strict=True)
        self.layers = tuple(eqx.nn.Linear(n + skip, width, dtype=kind, key=k) for n, k in pairs)
        self.norms = tuple(eqx.nn.LayerNorm(width, dtype=kind) for _ in range(depth)) if norm else ()
        self.last = eqx.nn.Linear(width + skip, out, dtype=kind, key=keys[-1])
        self.activation = activation

    def __call__(
        self, x: Float[Array, " size"], skip: Float[Array, " skip"], more: Sequence[Array] | None = None
    ) -> Float[Array, " out"]:
        """The output; `more` is added to what each layer, the last one included, gives before its activation."""
        push = [0.0] * (len(self.layers) + 1) if more is None else more
        for i, layer in enumerate(self.layers):
            x = layer(jnp.concatenate([x, skip])) + push[i]
            x = self.activation(self.norms[i](x) if self.norms else x)
        return self.last(jnp.concatenate([x, skip])) + push[-1]


class Decoder(eqx.Module):
    """p(y | x, z): mean and scale of a Gaussian in standardised units: sds, or a lower triangle where `full`."""

    net: SkipMLP
    size: int = eqx.field(static=True)
    latents: int = eqx.field(static=True)
    full: bool = eqx.field(static=True)

    def __init__(self, x: int, z: int, y: int, key: PRNGKeyArray, *, full: bool = False, **shape):
        self.size, self.latents, self.full = y, z, full
        self.net = SkipMLP(x, z, 2 * y + full * (y * (y - 1) // 2), key, **shape)

    @property
    def sizes(self) -> dict[str, int]:
        """What `__init__` needs for another of the same shape, activation and norm apart."""
        width, given = self.net.layers[0].weight.shape
        depth = len(self.net.layers)
        own = {"x": given - self.latents, "z": self.latents, "y": self.size}
        return own | {"full": self.full, "width": width, "depth": depth}

    def __call__(
        self, x: Float[Array, " x"], z: Float[Array, " z"]
    ) -> tuple[Float[Array, " y"], Float[Array, "*scale"]]:
        return gaussian(self.net(x, z), self.size, self.full)


class ExtendedDecoder(eqx.Module):
    """A decoder that stays as it is, with further latents whose weights are learned: what none of its own explains.

    At first they move means, each in a direction of its own; from nothing they would end as mere widths.
    """

    base: Decoder
    columns: tuple[Float[Array, "_ extra"], ...]  # of every layer
    extra: int = eqx.field(static=True)

    def __init__(self, base: Decoder, extra: int, key: PRNGKeyArray):
        self.base, self.extra = base, extra
        layers = (*base.net.layers, base.net.last)
        *inner, last = (jnp.zeros((layer.weight.shape[0], extra), layer.weight.dtype) for layer in layers)
        first = FIRST_PUSH * jax.random.normal(key, (base.size, extra), last.dtype)
        self.columns = (*inner, last.at[: base.size].set(first))

    @property
    def latents(self) -> int:
        """All of them."""
        return self.base.latents + self.extra

    @property
    def sizes(self) -> dict[str, int]:
        """The base's, and how many latents were added."""
        return self.base.sizes | {"extra": self.extra}

    def __call__(
        self, x: Float[Array, " x"], z: Float[Array, " z"]
    ) -> tuple[Float[Array, " y"], Float[Array, "*scale"]]:
        frozen = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, self.base)
        own, more = z[: self.base.latents], [c @ z[self.base.latents :] for c in self.columns]
        return gaussian(frozen.net(x, own, more), frozen.size, frozen.full)


def decoder_of(sizes: Mapping[str, int]) -> Decoder | ExtendedDecoder:
    """A decoder of these sizes whose weights are to be filled in."""
    own = {name: value for name, value in sizes.items() if name not in ("extra", "full")}
    base = Decoder(**own, full=bool(sizes["full"]), key=jax.random.key(0))
    return ExtendedDecoder(base, sizes["extra"], jax.random.key(0)) if "extra" in sizes else base


class Encoder(eqx.Module):
    """q(z | x, y), with dropout on its input."""

    net: SkipMLP
    dropout: eqx.nn.Dropout
    size: int = eqx.field(static=True)
    full: bool = eqx.field(static=True)

    def __init__(self, x: int, y: int, z: int, key: PRNGKeyArray, *, drop: float = 0.2, full: bool = False, **shape):
        self.size, self.full, self.dropout = z, full, eqx.nn.Dropout(drop)
        self.net = SkipMLP(x + y, 0, 2 * z + full * (z * (z - 1) // 2), key, **shape)

    def __call__(
        self, x: Float[Array, " x"], y: Float[Array, " y"], key: PRNGKeyArray | None = None
    ) -> tuple[Float[Array, " z"], Float[Array, "*scale"]]:
        given = self.dropout(jnp.concatenate([x, y]), key=key, inference=key is None)
        return gaussian(self.net(given, jnp.zeros(0, given.dtype)), self.size, self.full)


def gaussian(out: Float[Array, " out"], size: int, full: bool) -> tuple[Float[Array, " size"], Float[Array, "*scale"]]:
    """Mean and sd (or Cholesky factor) from a network's output."""
    mean, log_sd = out[:size], jnp.clip(out[size : 2 * size], *LOG_SD)
    if not full:
        return mean, jnp.exp(log_sd)
    below = jnp.zeros((size, size), out.dtype).at[jnp.tril_indices(size, -1)].set(out[2 * size :])
    sd = jnp.exp(log_sd)
    return mean, sd[:, None] * (below + jnp.eye(size, dtype=out.dtype))
