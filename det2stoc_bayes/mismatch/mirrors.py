"""Parameters that recordings tell but for a mirror: with the signs of some of them turned they tell as much.

A hinge feels the squares and products of a frame's rates, an arm in a plane how far gravity leans out of it and not to
which side, and a body that swings in a plane a point before it as one behind it. The posterior has several tops
then, of which a fit ends on one.
"""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.belief import Belief
from det2stoc_bayes.mismatch.effects import PlacedEffect

ALIKE = 1.0  # nats
MOST = 3  # that are turned at once
CLEAR = 2.0  # sds of a component's posterior from the mirror: a nearer one spans it anyway


def mirrored(belief: Belief, placed: PlacedEffect) -> list[Float[np.ndarray, "draws size"]]:
    """Draws about each other top that tells the recordings as well, likeliest first; none where no mirror does."""
    density, here = belief.density, belief.fit.point.z
    flips = [np.where(np.isin(np.arange(len(here)), turned), -1.0, 1.0) for turned in _turned(belief, placed)]
    if not flips:
        return []
    height, *heights = density.log_density(np.stack([here, *(flip * here for flip in flips)]))
    return [flips[i] * belief.z for i in np.argsort(-np.array(heights)) if heights[i] > height - ALIKE]


def _turned(belief: Belief, placed: PlacedEffect) -> Iterator[tuple[int, ...]]:
    """Unknowns of the effect whose signs may be turned together."""
    problem = belief.fit.problem
    begin = problem.num_psi
    for other in problem.effects:
        if other == placed and other.effect.listed:
            signed = np.repeat([not p.positive for p in other.effect.unknown], [p.size for p in other.effect.unknown])
            rows = begin + np.flatnonzero(signed)
            clear = [int(i) for i in rows if abs(belief.z[:, i].mean()) > CLEAR * belief.z[:, i].std()]
            for count in range(1, min(len(clear), MOST) + 1):
                yield from combinations(clear, count)
        begin += other.size
