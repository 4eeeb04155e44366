"""A learned stochastic simulator: p(s' | s, a) with a latent in the place of psi."""

import io
import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float, Key, PRNGKeyArray

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.files import atomic_write
from det2stoc_bayes.inference._cvae import normal, standard_normal
from det2stoc_bayes.inference._latent import LatentMixture
from det2stoc_bayes.inference._networks import Decoder, ExtendedDecoder, decoder_of
from det2stoc_bayes.transitions import Scaling, Transitions

FORMAT = "det2stoc stochastic simulator 2"


@dataclass(frozen=True, eq=False)
class StochasticSimulator:
    """A decoder, the prior of its latent, and the units it works in.

    `rotations`: where rotation matrices (nine numbers, by rows) begin in the state; next states hold the nearest ones.
    `latent`: the latent's prior, standard normal where nothing is given.
    """

    decoder: Decoder | ExtendedDecoder
    scaling: Scaling
    rotations: tuple[int, ...] = ()
    latent: LatentMixture | None = None

    @property
    def prior(self) -> dist.Distribution:
        """The latent's."""
        return standard_normal(self.decoder.latents) if self.latent is None else self.latent()

    def latents(self, key: PRNGKeyArray, count: int) -> Float[Array, "count z"]:
        """Draws from the prior."""
        return jnp.asarray(self.prior.sample(key, (count,)))

    @property
    def num_states(self) -> int:
        """Numbers of a state."""
        return len(self.scaling.change_sd)

    @property
    def num_actions(self) -> int:
        """Numbers of an action."""
        return len(self.scaling.given_mean) - self.num_states

    def sample(
        self,
        key: PRNGKeyArray,
        state: Float[np.ndarray, "rows s"],
        action: Float[np.ndarray, "rows a"],
        z: Float[Array, "rows z"] | None = None,
    ) -> Float[np.ndarray, "rows s"]:
        """Next states; every row's latent is drawn from the prior where none is given.

        Raises Det2StocError where a state or an action has another size than those that were learned from.
        """
        state = rows_of("state", state, self.num_states)
        action = rows_of("action", action, self.num_actions, len(state))
        latent, noise = jax.random.split(key)
        given = np.concatenate([state, action], 1)
        z = self.latents(latent, len(state)) if z is None else z
        mean, scale = _decode(self.decoder, jnp.asarray(self.scaling.inputs(given)), jnp.asarray(z, jnp.float32))
        drawn = np.asarray(normal(mean, scale).sample(noise), float)
        return self._valid(state + self.scaling.linear(given) + drawn * self.scaling.change_sd)

    def _valid(self, state: Float[np.ndarray, "*rows s"]) -> Float[np.ndarray, "*rows s"]:
        """The state with its rotation matrices replaced by the nearest rotations."""
        for begin in self.rotations:
            block = state[..., begin : begin + 9]
            state[..., begin : begin + 9] = nearest_rotation(block.reshape(*block.shape[:-1], 3, 3)).reshape(
                block.shape
            )
        return state

    def rollout(
        self,
        key: PRNGKeyArray,
        state: Float[np.ndarray, "rows s"],
        actions: Float[np.ndarray, "rows steps a"],
        *,
        hold: bool = True,
    ) -> Float[np.ndarray, "rows samples s"]:
        """States of episodes, the first one included; `hold`: an episode's latent stays what it is, as psi does."""
        if np.ndim(actions) != 3:
            raise Det2StocError(f"actions: found shape {np.shape(actions)}; allowed: (rows, steps, {self.num_actions})")
        state = rows_of("state", state, self.num_states, len(actions))
        first, key = jax.random.split(key)
        z = self.latents(first, len(state)) if hold else None
        out = [np.asarray(state, float)]
        for k in range(actions.shape[1]):
            key, now = jax.random.split(key)
            out.append(self.sample(now, out[-1], actions[:, k], z))
        return np.stack(out, 1)

    def draws(
        self, key: PRNGKeyArray, data: Transitions, num_draws: int
    ) -> tuple[Float[np.ndarray, "draws rows s"], Float[np.ndarray, "draws rows"]]:
        """Changes drawn for every row, and log p(change | s, a, z) of the recorded one under each draw's latent."""
        x, y = (jnp.asarray(a) for a in self.scaling.standard(data))
        drawn, terms = _drawn(self.decoder, self.prior, x, y, jax.random.split(key, num_draws))
        changes = self.scaling.linear(data.given) + np.asarray(drawn, float) * self.scaling.change_sd
        changes = self._valid(data.state + changes) - data.state if self.rotations else changes
        return changes, np.asarray(terms, float) - self.scaling.log_volume

    def save(self, path: str | os.PathLike[str]) -> None:
        """One file: a line of JSON, then the networks."""
        atomic_write(path, self.to_bytes())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "StochasticSimulator":
        """What `save` wrote; a Det2StocError where it is something else."""
        try:
            return cls.from_bytes(Path(path).read_bytes())
        except (OSError, ValueError) as error:
            raise Det2StocError(f"{path}: found no stochastic simulator; allowed: a file that save() wrote") from error

    def to_bytes(self) -> bytes:
        """What `from_bytes` reads."""
        buffer = io.BytesIO()
        units = {name: value.tolist() for name, value in asdict(self.scaling).items()}
        header = {"format": FORMAT, "decoder": self.decoder.sizes, "scaling": units}
        header |= {"rotations": self.rotations, "latent": self.latent and self.latent.to_json()}
        buffer.write((json.dumps(header) + "\n").encode())
        eqx.tree_serialise_leaves(buffer, self.decoder)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> "StochasticSimulator":
        """What `to_bytes` made; a ValueError where it is something else."""
        file = io.BytesIO(content)
        try:
            header: dict[str, Any] = json.loads(file.readline())
            if header["format"] != FORMAT:
                raise ValueError(f"found {header['format']}; allowed: {FORMAT}")
            decoder = eqx.tree_deserialise_leaves(file, decoder_of(header["decoder"]))
            scaling = Scaling(**{name: np.asarray(v) for name, v in header["scaling"].items()})
            latent = header["latent"] and LatentMixture.from_json(header["latent"])
            return cls(decoder, scaling, tuple(header["rotations"]), latent)
        except (KeyError, TypeError, AttributeError, EOFError, RuntimeError) as error:
            raise ValueError("found no stochastic simulator") from error


def rows_of(what: str, values: Any, size: int, count: int | None = None) -> Float[np.ndarray, "rows size"]:
    """Numbers as an array of rows; a Det2StocError says what was found and what is allowed."""
    found = np.asarray(values, float)
    if found.ndim != 2 or found.shape[1] != size or (count is not None and len(found) != count):
        rows = "rows" if count is None else count
        raise Det2StocError(f"{what}: found shape {found.shape}; allowed: ({rows}, {size})")
    return found


def nearest_rotation(matrix: Float[np.ndarray, "*rows 3 3"]) -> Float[np.ndarray, "*rows 3 3"]:
    """In the Frobenius norm (Kabsch 1976): U diag(1, 1, det) V' of the singular value decomposition."""
    u, _, v = np.linalg.svd(matrix)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ v))[..., None]
    return u @ v


@eqx.filter_jit
def _decode(decoder: Callable[..., Any], x: Float[Array, "rows x"], z: Float[Array, "rows z"]) -> tuple[Array, Array]:
    return jax.vmap(decoder)(x, z)


@eqx.filter_jit
def _drawn(
    decoder: Callable[..., Any],
    prior: dist.Distribution,
    x: Float[Array, "rows x"],
    y: Float[Array, "rows y"],
    keys: Key[Array, " draws"],
) -> tuple[Float[Array, "draws rows y"], Float[Array, "draws rows"]]:
    def one(key: PRNGKeyArray) -> tuple[Array, Array]:
        latent, noise = jax.random.split(key)
        p = normal(*jax.vmap(decoder)(x, prior.sample(latent, (len(x),))))
        return jnp.asarray(p.sample(noise)), jnp.asarray(p.log_prob(y))

    return jax.lax.map(one, keys)
