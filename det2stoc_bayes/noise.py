"""Measurement noise of each column: given by the study, or estimated from the scatter between neighbouring samples."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.segments import Segments

# Third differences remove a local quadratic; of white noise they have variance 1 + 9 + 9 + 1 = 20.
THIRD_DIFFERENCE_VARIANCE = 20.0


def noise_sd(segments: Segments, given: Mapping[str, float]) -> Float[np.ndarray, " columns"]:
    """One sd a column, in the column's unit."""
    return np.array([given.get(c) or _scatter(segments.values[:, :, j]) for j, c in enumerate(segments.columns)])


def _scatter(values: Float[np.ndarray, "segments samples"]) -> float:
    third = np.diff(values, 3, axis=1)
    third = third[np.isfinite(third)]
    if len(third) < 8:
        return max(float(np.nanstd(values)), 1e-9)
    # The median is not moved by the few places where the motion itself turns sharply.
    spread = float(np.median(np.abs(third))) / 0.6745
    floor = 1e-6 * max(float(np.nanmax(np.abs(values))), 1e-6)
    return max(spread / np.sqrt(THIRD_DIFFERENCE_VARIANCE), floor)
