"""The prior of a latent where it is not the standard normal: a mixture of normals, given or learned."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jaxtyping import Array, Float, PRNGKeyArray

APART = 0.5  # spread of the components' first means


class LatentMixture(eqx.Module):
    """Weights, means and sds of independent normals' mixture."""

    logits: Float[Array, " components"]
    loc: Float[Array, "components z"]
    log_scale: Float[Array, "components z"]

    @classmethod
    def first(cls, size: int, num_components: int, key: PRNGKeyArray) -> "LatentMixture":
        """Where learning starts: about the standard normal, components apart."""
        loc = APART * jax.random.normal(key, (num_components, size), jnp.float32)
        return cls(jnp.zeros(num_components, jnp.float32), loc, jnp.zeros_like(loc))

    @classmethod
    def normal(cls, loc: Float[Any, " z"], scale: Float[Any, " z"]) -> "LatentMixture":
        """A single component."""
        loc, log_scale = jnp.asarray(loc, jnp.float32), jnp.log(jnp.asarray(scale, jnp.float32))
        return cls(jnp.zeros(1, jnp.float32), loc[None], log_scale[None])

    def __call__(self) -> dist.Distribution:
        """The distribution."""
        normals = dist.Normal(self.loc, jnp.exp(self.log_scale)).to_event(1)
        return dist.MixtureSameFamily(dist.Categorical(logits=self.logits), normals)

    def to_json(self) -> dict[str, Any]:
        """Plain lists."""
        return {name: value.tolist() for name, value in vars(self).items()}

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "LatentMixture":
        """What `to_json` gave."""
        return cls(**{name: jnp.asarray(content[name], jnp.float32) for name in ("logits", "loc", "log_scale")})
