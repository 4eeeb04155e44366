"""What no initial state explains of errors with heavy tails: the states are refitted, since a projection cannot bend.

The likeliest change s of the initial states under a Student-t density of the errors e - S s (in noise sds) and a
normal prior, by iteratively reweighted least squares, the weight being (nu + 1) / (nu + e^2): the EM algorithm of
Lange, Little and Taylor (1989).
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.measurement import Measurement

Array = Any
ITERATIONS = 60
CLOSE = 1e-11  # prior sds of a state, below which a change is none


def left_over(
    error: Array,
    offset: Float[np.ndarray, "segments states"],
    sensitivity: Float[np.ndarray, "segments values states"],
    prior_sd: Float[np.ndarray, "segments states"],
    measurement: Measurement,
    xp: Any = np,
) -> Array:
    """Bent errors (segments, values, points) over the prior's rows, at the likeliest states of each point.

    `offset`: guessed states less those that the errors were found from; `sensitivity`: of predictions, in noise sds.
    """
    nu = measurement.degrees_of_freedom
    assert nu is not None
    scaled = xp.asarray(sensitivity * prior_sd[:, None])  # by states in their prior's sds
    guess = xp.asarray(offset / prior_sd)[..., None]
    identity = xp.eye(prior_sd.shape[1])

    def better(x):
        weight = (nu + 1) / (nu + (error - scaled @ x) ** 2)
        return refitted(weight)

    def refitted(weight):
        inner = xp.einsum("svi,svp,svj->spij", scaled, weight, scaled) + identity
        pull = xp.einsum("svi,svp->spi", scaled, weight * error) + xp.swapaxes(guess, 1, 2)
        return xp.swapaxes(xp.linalg.solve(inner, pull[..., None])[..., 0], 1, 2)

    x = refitted(xp.ones_like(error))
    if xp is np:
        for _ in range(ITERATIONS):
            before, x = x, better(x)
            if not np.nanmax(np.abs(x - before), initial=0.0) > CLOSE:
                break
    else:
        import jax

        x = jax.lax.fori_loop(0, ITERATIONS, lambda _, at: better(at), x)
    return xp.concatenate([measurement.bend(error - scaled @ x, xp), guess - x], 1)
