"""Single samples that are out of line with their neighbours, while the neighbours are in line with each other."""

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view

FEWEST = 20  # samples: fewer do not tell what is usual
OUT_OF_LINE = 8.0  # robust sds of what a cubic through four neighbours leaves
IN_LINE = 0.2  # of the glitch: what a cubic past it may leave at its neighbours, less than at a kink
REACH = 8  # samples either way
ROUGHEST = 4.0  # times the largest of the others within reach, as impacts and encoders' steps come in groups
WHOLE, MOSTLY = 0.05, 0.9  # multiples of a quantised channel's step, and the share of its steps that are
RAREST = 3.0, 99.0  # times a percentile of all others: what happens often is no glitch


def glitches(
    time: Float[np.ndarray, " samples"], values: Float[np.ndarray, " samples"]
) -> Bool[np.ndarray, " samples"]:
    """Where one recorded value of a channel stands alone; cells that are NaN are passed over.

    A jump or a kink moves the neighbours' predictions too and is none. The first and last three values are not judged.
    """
    out, seen = np.zeros(len(values), bool), np.flatnonzero(np.isfinite(values))
    if len(seen) < FEWEST:
        return out
    t, x = (sliding_window_view(a[seen], 7) for a in (time, values))
    middle = np.abs(_left_over(t, x, 3, (1, 2, 4, 5)))
    neighbours = np.maximum(np.abs(_left_over(t, x, 2, (0, 1, 4, 5))), np.abs(_left_over(t, x, 4, (1, 2, 5, 6))))
    sd = max(float(np.median(middle)) / 0.6745, resolution(values[seen]), 1e-9 * float(np.abs(x).max()))
    alone = (middle > OUT_OF_LINE * sd) & (neighbours < IN_LINE * middle) & (middle > ROUGHEST * _near(middle))
    others = middle[~np.convolve(alone, np.ones(5), "same").astype(bool)]
    if len(others):
        alone &= middle > RAREST[0] * np.percentile(others, RAREST[1])
    out[seen[3:-3][alone]] = True
    return out


def _near(left_over: Float[np.ndarray, " windows"]) -> Float[np.ndarray, " windows"]:
    """The largest within reach whose cubic does not pass through the sample itself."""
    padded = np.pad(left_over, REACH)
    near = sliding_window_view(padded, 2 * REACH + 1)
    return np.delete(near, range(REACH - 2, REACH + 3), axis=1).max(axis=1)


def resolution(values: Float[np.ndarray, " samples"]) -> float:
    """sd of a quantised channel's rounding: its smallest step over sqrt(12); 0 where steps are no multiples of it."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-12 * np.abs(values).max(initial=0.0)]
    if len(steps) == 0:
        return 0.0
    multiples = steps / steps.min()
    whole = np.abs(multiples - np.rint(multiples)) < WHOLE
    return float(steps.min()) / np.sqrt(12) if whole.mean() > MOSTLY else 0.0


def _left_over(t: np.ndarray, x: np.ndarray, at: int, nodes: tuple[int, ...]) -> np.ndarray:
    """A window's value less that of the cubic through four others of it, in units in which white noise keeps its sd."""
    predicted, variance = np.zeros(len(x)), np.ones(len(x))
    for i in nodes:
        others = [j for j in nodes if j != i]
        weight = np.prod([(t[:, at] - t[:, j]) / (t[:, i] - t[:, j]) for j in others], axis=0)
        predicted += weight * x[:, i]
        variance += weight**2
    return (x[:, at] - predicted) / np.sqrt(variance)
