"""det2stoc's CVAE on problems of vectors: p(x | theta) learned from simulations and frozen, then read backwards.

The decoder, its training and the encoder through the frozen decoder are those of the method, whose transitions begin
nowhere here (a state of zeros) and end in x; recordings are the simulations' own x, so that the encoder serves for any.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.inference._amortized import Options, pretrain, recognize
from det2stoc_bayes.inference._cvae import Cvae, normal
from det2stoc_bayes.transitions import Scaling, Transitions


@dataclass(frozen=True, eq=False)
class Recognizer:
    """q(z | x), a Gaussian."""

    cvae: Cvae
    scaling: Scaling

    def sample(self, key: jax.Array, x: Float[np.ndarray, " features"], count: int) -> Float[np.ndarray, "count size"]:
        """Draws of z for one x."""
        given, y = (jnp.asarray(a[0]) for a in self.scaling.standard(transitions(x[None])))
        with jax.enable_x64(False):
            return np.asarray(normal(*self.cvae.encoder(given, y)).sample(key, (count,)), float)


def train(
    z: Float[np.ndarray, "sims size"], x: Float[np.ndarray, "sims features"], key: jax.Array, options: Options
) -> Recognizer:
    """Decoder, then encoder."""
    simulated, (first, second) = transitions(x), jax.random.split(key)
    scaling = Scaling.of(simulated)
    with jax.enable_x64(False):
        decoder, _ = pretrain(simulated, z, scaling, first, options, lambda *_: None)
        cvae, _ = recognize(simulated, decoder, scaling, second, options, lambda *_: None)
    return Recognizer(cvae, scaling)


def transitions(x: Float[np.ndarray, "sims features"]) -> Transitions:
    """Each x as an episode of one step."""
    return Transitions(np.zeros(x.shape), np.zeros((len(x), 0)), x, np.arange(len(x)))
