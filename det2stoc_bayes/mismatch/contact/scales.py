"""The likelihood of innovations whose scale is its own in each column, and unknown.

Columns that contact makes chaotic get a large scale and little say. Errors are Student-t: some samples make or break a
contact at another moment than predicted, and are far off. What is significant follows from scatter over blocks of
samples, whose errors may be correlated.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

DEGREES = 4.0  # of freedom
NUM_ROUNDS = 40  # of the fixed point of a scale
LEAST = 1.0  # noise sds: no scale is smaller
LAGS = (0.75, 0.5, 0.25)  # weights of neighbours one, two and three blocks apart (Bartlett's)


@dataclass(frozen=True, eq=False)
class Scales:
    """Scale of the errors in noise sds in each column; infinite where nothing was recorded."""

    values: Float[np.ndarray, " columns"]

    def only(self, column: int) -> "Scales":
        """That of one column."""
        return Scales(self.values[[column]])

    def each(self, errors: Float[np.ndarray, "blocks samples columns"]) -> Float[np.ndarray, "blocks samples columns"]:
        """-log likelihood of each error, up to a constant; 0 where nothing was recorded."""
        u = errors / self.values
        with np.errstate(divide="ignore", invalid="ignore"):
            each = np.log(self.values) + 0.5 * (DEGREES + 1) * np.log1p(u * u / DEGREES)
        return np.where(np.isfinite(errors), each, 0.0)

    def losses(self, errors: Float[np.ndarray, "blocks samples columns"]) -> Float[np.ndarray, " blocks"]:
        """-log likelihood of each block, up to a constant."""
        return self.each(errors).sum((1, 2))

    def weights(
        self, errors: Float[np.ndarray, "blocks samples columns"]
    ) -> Float[np.ndarray, "blocks samples columns"]:
        """Of squared errors, as iteratively reweighted least squares has them; 0 where nothing was recorded."""
        u = errors / self.values
        weight = (DEGREES + 1) / (DEGREES + u * u) / self.values**2
        return np.where(np.isfinite(errors), weight, 0.0)


def scales_of(errors: Float[np.ndarray, "blocks samples columns"]) -> Scales:
    """The most likely scales of these errors."""
    there = np.isfinite(errors).reshape(-1, errors.shape[-1])
    square = np.nan_to_num(errors).reshape(there.shape) ** 2
    count, seen = np.maximum(there.sum(0), 1), there.any(0)
    middle = np.nanmedian(np.where(there | ~seen, square, np.nan), axis=0)
    s2 = np.maximum(middle, LEAST**2)
    for _ in range(NUM_ROUNDS):
        s2 = np.maximum((there * (DEGREES + 1) * square / (DEGREES + square / s2)).sum(0) / count, LEAST**2)
    return Scales(np.where(seen, np.sqrt(s2), np.inf))


def scatter(values: Float[np.ndarray, "blocks k"], recording: Int[np.ndarray, " blocks"]) -> Float[np.ndarray, "k k"]:
    """Covariance of the sum over blocks, neighbours of a recording correlated (Newey and West, 1987)."""
    total = values.T @ values
    for lag, weight in enumerate(LAGS, 1):
        same = (recording[lag:] == recording[:-lag])[:, None]
        cross = (values[lag:] * same).T @ values[:-lag]
        total = total + weight * (cross + cross.T)
    return total


def certainty(gains: Float[np.ndarray, " blocks"], recording: Int[np.ndarray, " blocks"]) -> float:
    """Sum of gains over blocks in standard errors of it."""
    centred = (gains - gains.mean())[:, None]
    variance = max(float(scatter(centred, recording)[0, 0]), float((centred**2).sum()) * 0.5, 1e-12)
    return float(gains.sum() / np.sqrt(variance))
