"""Measurement noise of each column: given by the study, or estimated from what neighbouring samples leave.

A polynomial through k samples misses the next by noise and by what the motion bends beyond it. The higher the degree,
the less a motion that is slow beside the sampling adds, and the fewer windows are free of kinks and jumps; so the
degree is raised as long as that lowers the estimate by more than chance.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from det2stoc_bayes.recording_glitches import resolution
from det2stoc_bayes.segments import Segments

ORDERS = range(3, 13)  # of the differences: 3 removes a quadratic
FEWEST = 8  # differences
CHANCE = 1.5  # standard errors by which a higher order must lower the estimate


def noise_sd(segments: Segments, given: Mapping[str, float]) -> Float[np.ndarray, " columns"]:
    """One sd a column, in the column's unit."""
    return np.array(
        [given.get(c) or _scatter(segments.time, segments.values[:, :, j]) for j, c in enumerate(segments.columns)]
    )


def _scatter(time: Float[np.ndarray, "segments samples"], values: Float[np.ndarray, "segments samples"]) -> float:
    """Never below the rounding of a quantised channel."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 1.0  # weighs nothing
    rounding = max((resolution(v[np.isfinite(v)]) for v in values), default=0.0)
    floor = max(1e-6 * max(float(np.abs(finite).max()), 1e-6), rounding)
    best = np.inf
    for order in ORDERS:
        left = np.concatenate([_differences(t, v, order) for t, v in zip(time, values, strict=True)])
        if len(left) < FEWEST:
            break
        # The median is not moved by the few places where the motion itself turns sharply.
        spread = float(np.median(np.abs(left))) / 0.6745
        if spread < best * (1 - CHANCE / np.sqrt(len(left))):
            best = spread
    return max(best, floor) if np.isfinite(best) else max(float(np.std(finite)), floor, 1e-9)


def _differences(
    time: Float[np.ndarray, " samples"], values: Float[np.ndarray, " samples"], order: int
) -> Float[np.ndarray, " windows"]:
    """Divided differences of the recorded samples, at any times, scaled so that white noise keeps its sd."""
    seen = np.isfinite(values)
    if seen.sum() <= order:
        return np.zeros(0)
    t, x = (sliding_window_view(a[seen], order + 1) for a in (time, values))
    apart = t[:, :, None] - t[:, None, :] + (t[:, -1] - t[:, 0])[:, None, None] * np.eye(order + 1)
    weight = 1.0 / np.prod(apart / (t[:, -1] - t[:, 0])[:, None, None], axis=2)
    return (weight * x).sum(1) / np.linalg.norm(weight, axis=1)
