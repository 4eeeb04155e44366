"""Likelihood of segments whose initial states are latent, with those states integrated out.

With residuals r of a segment, noise sds s and the prediction's sensitivity A to the initial state x ~ N(x0, P),
    r ~ N(0, diag(s^2) + A P A'),
evaluated through a thin QR factorization of [A / s; P^(-1/2)], so that its cost is linear in the number of samples.
The linearization in x is the only approximation (initial states are known to about the measurement noise).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.measurement import Measurement

Array = Any
NORMAL = Measurement()


@dataclass(frozen=True, eq=False)
class LatentStarts:
    """Factorization for every segment; project() takes a residual to what no initial state can explain."""

    weight: Float[np.ndarray, "segments values"]  # of a sensitivity: 1 / noise sd; 0 where nothing was recorded
    basis: Float[np.ndarray, "segments stacked states"]
    triangle: Float[np.ndarray, "segments states states"]
    prior_sd: Float[np.ndarray, "segments states"]
    log_peak: Float[np.ndarray, " segments"] | None = None  # log density of no error; None: normal, of `weight`

    @property
    def num_observed(self) -> int:
        """Recorded values."""
        return int((self.weight > 0).sum())

    @property
    def degrees_of_freedom(self) -> int:
        """Recorded values less those that the initial states use up."""
        return max(self.num_observed - self.prior_sd.size, 1)

    @property
    def log_normalizer(self) -> float:
        """-1/2 log det(2 pi (R + A P A')), summed over segments; for R of a normal measurement."""
        return float(self.log_normalizers.sum())

    @property
    def log_normalizers(self) -> Float[np.ndarray, " segments"]:
        """The terms of `log_normalizer`, one a segment."""
        diagonal = np.abs(np.diagonal(self.triangle, axis1=1, axis2=2))
        peak = log_peak(self.weight) if self.log_peak is None else self.log_peak
        return peak - np.log(self.prior_sd).sum(1) - np.log(diagonal).sum(1)

    def stack(self, columns: Array, offset: Array | None = None, xp: Any = np) -> Array:
        """Whitened columns (segments, values, k) with the start prior's rows below them."""
        return self.stack_whitened(columns * self.weight[..., None], offset, xp)

    def stack_whitened(self, columns: Array, offset: Array | None = None, xp: Any = np) -> Array:
        """The same of columns that are whitened already, as bent residuals are."""
        below = (
            xp.zeros((*self.prior_sd.shape, columns.shape[-1])) if offset is None else offset / self.prior_sd[..., None]
        )
        return xp.concatenate([columns, below], 1)

    def project(self, stacked: Array, xp: Any = np) -> Array:
        """The part of stacked columns that is orthogonal to every change of the initial states."""
        return stacked - self.basis @ (xp.swapaxes(self.basis, 1, 2) @ stacked)

    def best_start(self, stacked: Float[np.ndarray, "segments stacked 1"]) -> Float[np.ndarray, "segments states"]:
        """Change of the initial states that explains most of a stacked residual."""
        inner = np.swapaxes(self.basis, 1, 2) @ stacked
        return np.linalg.solve(self.triangle, inner)[..., 0]


def factorize(
    sensitivity: Float[np.ndarray, "segments values states"],
    weight: Float[np.ndarray, "segments values"],
    prior_sd: Float[np.ndarray, "segments states"],
    peak: Float[np.ndarray, " segments"] | None = None,
) -> LatentStarts:
    """QR of the whitened sensitivity stacked on the prior of the initial states; `peak` as `LatentStarts.log_peak`."""
    below = np.eye(prior_sd.shape[1]) / prior_sd[:, :, None]
    basis, triangle = np.linalg.qr(np.concatenate([sensitivity * weight[..., None], below], 1))
    return LatentStarts(weight, basis, triangle, prior_sd, peak)


def log_peak(
    weight: Float[np.ndarray, "segments values"], measurement: Measurement = NORMAL
) -> Float[np.ndarray, " segments"]:
    """log density of residuals that are all 0, for weights that are 1 / noise sd, or 0."""
    recorded = weight > 0
    return np.log(np.where(recorded, weight, 1.0)).sum(1) + recorded.sum(1) * measurement.log_peak


def align_quaternions(predicted: Array, observed: Array, groups: list[list[int]], xp: Any = np) -> Array:
    """Predictions with the sign of each quaternion that is nearer to the recorded one (q and -q are equal)."""
    for group in groups:
        product = xp.sum(predicted[..., group] * xp.nan_to_num(observed[..., group]), -1, keepdims=True)
        sign = xp.where(product < 0, -1.0, 1.0)
        if xp is np:
            predicted = np.array(predicted)
            predicted[..., group] *= sign
        else:
            predicted = predicted.at[..., xp.array(group)].multiply(sign)
    return predicted


def residuals(predicted: Array, observed: Array, groups: list[list[int]], xp: Any = np) -> Array:
    """Recorded minus predicted values, flat over samples and columns; 0 where nothing was recorded."""
    difference = observed - align_quaternions(predicted, observed, groups, xp)
    difference = xp.where(xp.isnan(observed), 0.0, difference)
    return difference.reshape(*difference.shape[:-2], -1)
