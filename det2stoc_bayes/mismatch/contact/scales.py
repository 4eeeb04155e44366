"""The likelihood of window errors whose scale is its own at each horizon and column, and unknown.

Chaotic columns get a large scale and no say. Errors are Student-t: some windows make or break a contact at another
moment than predicted, and are far off. Horizons and overlapping windows are correlated, so that the log likelihood is
a composite one: it says where the optimum is, while what is significant follows from its scatter over windows.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

DEGREES = 3.0  # of freedom
NUM_ROUNDS = 40  # of the fixed point of a scale
LEAST = 1.0  # noise sds: no scale is smaller
LAGS = (0.75, 0.5, 0.25)  # weights of neighbours one, two and three windows apart (Bartlett's)


@dataclass(frozen=True, eq=False)
class Scales:
    """Scale of the errors in noise sds at each horizon and column; infinite where nothing was recorded."""

    values: Float[np.ndarray, "horizons columns"]

    def losses(self, errors: Float[np.ndarray, "windows horizons columns"]) -> Float[np.ndarray, " windows"]:
        """-log likelihood of each window, up to a constant."""
        u = errors / self.values
        with np.errstate(divide="ignore", invalid="ignore"):
            each = np.log(self.values) + 0.5 * (DEGREES + 1) * np.log1p(u * u / DEGREES)
        return np.where(np.isfinite(errors), each, 0.0).sum((1, 2))

    def weights(
        self, errors: Float[np.ndarray, "windows horizons columns"]
    ) -> Float[np.ndarray, "windows horizons columns"]:
        """Of squared errors, as iteratively reweighted least squares has them; 0 where nothing was recorded."""
        u = errors / self.values
        weight = (DEGREES + 1) / (DEGREES + u * u) / self.values**2
        return np.where(np.isfinite(errors), weight, 0.0)


def scales_of(errors: Float[np.ndarray, "windows horizons columns"]) -> Scales:
    """The most likely scales of these errors."""
    there = np.isfinite(errors)
    square, count = np.where(there, errors, 0.0) ** 2, np.maximum(there.sum(0), 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.nanmedian(np.where(there | ~there.any(0), square, np.nan), axis=0)
        s2 = np.maximum(middle, LEAST**2)
        for _ in range(NUM_ROUNDS):
            s2 = np.maximum((there * (DEGREES + 1) * square / (DEGREES + square / s2)).sum(0) / count, LEAST**2)
    return Scales(np.where(there.any(0), np.sqrt(np.nan_to_num(s2, nan=1.0)), np.inf))


def scatter(values: Float[np.ndarray, "windows k"], recording: Int[np.ndarray, " windows"]) -> Float[np.ndarray, "k k"]:
    """Covariance of the sum over windows, neighbours of a recording correlated (Newey and West, 1987)."""
    total = values.T @ values
    for lag, weight in enumerate(LAGS, 1):
        same = (recording[lag:] == recording[:-lag])[:, None]
        cross = (values[lag:] * same).T @ values[:-lag]
        total = total + weight * (cross + cross.T)
    return total


def certainty(gains: Float[np.ndarray, " windows"], recording: Int[np.ndarray, " windows"]) -> float:
    """Sum of gains over windows in standard errors of it."""
    centred = (gains - gains.mean())[:, None]
    variance = max(float(scatter(centred, recording)[0, 0]), float((centred**2).sum()) * 0.5, 1e-12)
    return float(gains.sum() / np.sqrt(variance))
