"""Angles that a recorder wrapped into one turn."""

import numpy as np
from jaxtyping import Float

TURN = 2 * np.pi
RANGES = ((-np.pi, np.pi), (0.0, TURN))  # what recorders wrap into
SLACK = 1e-3  # rad beyond them, by rounding
FASTEST = 2.5  # rad between samples: beyond it a jump tells nothing
ALIKE = 2.0  # largest ratio of a step across the seam to the largest other step


def unwrap(position: Float[np.ndarray, " samples"]) -> tuple[Float[np.ndarray, " samples"], int]:
    """A hinge's recorded angle [rad] without the jumps of a whole turn, and how many there were.

    Only where all values lie in one of `RANGES`, and where the steps across the seam are, less a turn, like the others.
    """
    seen = np.flatnonzero(np.isfinite(position))
    x = position[seen]
    if len(x) < 3 or not any(low - SLACK <= x.min() and x.max() <= high + SLACK for low, high in RANGES):
        return position, 0
    step = np.diff(x)
    turns = np.rint(step / TURN)
    jumps = turns != 0
    if not jumps.any() or jumps.all():
        return position, 0
    ordinary, across = np.abs(step[~jumps]).max(), np.abs(step - TURN * turns)[jumps].max()
    if ordinary > FASTEST or across > ALIKE * ordinary + SLACK:
        return position, 0
    out = position.copy()
    out[seen[1:]] -= TURN * np.cumsum(turns)
    return out, int(jumps.sum())
