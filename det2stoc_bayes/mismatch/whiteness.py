"""Whether a fit leaves white noise: the test of a model whose measurement noise is not known.

Where the noise is inferred its size cannot show a misfit; but what a simulator leaves out persists from sample to
sample, while measurement noise does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from det2stoc_bayes.mismatch.evidence import whitened
from det2stoc_bayes.optimize import Fit

MOST_LAGS = 10
FEWEST = 8  # pairs of samples for each lag


@dataclass(frozen=True)
class Whiteness:
    """Box and Pierce's test of each column's innovations; a small `p_values` entry says that they are not white."""

    columns: tuple[str, ...]
    correlation: Float[np.ndarray, "columns lags"]  # NaN where there are too few pairs
    p_values: Float[np.ndarray, " columns"]

    @property
    def p_value(self) -> float:
        """Of all columns together (Bonferroni)."""
        return float(min(1.0, len(self.p_values) * np.min(self.p_values, initial=1.0)))

    @property
    def worst(self) -> str | None:
        """The column that is least white."""
        return self.columns[int(np.argmin(self.p_values))] if self.columns else None


def whiteness(fit: Fit) -> Whiteness:
    """Of the residuals that no initial state of a fit explains; fits of long segments are tested best."""
    segments = fit.problem.segments
    fitted = fit.linear.latent.prior_sd.shape[1] + fit.problem.size / segments.count
    return of_residuals(segments.columns, whitened(fit), num_fitted=fitted / len(segments.columns))


def of_residuals(
    columns: Sequence[str], residuals: Float[np.ndarray, "segments samples columns"], *, num_fitted: float = 0.0
) -> Whiteness:
    """Of residuals with NaN where nothing was recorded.

    What was fitted, `num_fitted` unknowns a segment and column, makes white noise correlate by -num_fitted / samples at
    each lag; that is taken out.
    """
    lags = max(1, min(MOST_LAGS, residuals.shape[1] // 4))
    found = [_correlation(residuals[:, :, j], lags, num_fitted) for j in range(residuals.shape[2])]
    correlation = np.array([rho for rho, _ in found]).reshape(len(columns), lags)
    statistic = np.array([np.nansum(n * rho**2) for rho, n in found])
    used = np.isfinite(correlation).sum(1)
    p_values = np.where(used > 0, chi2.sf(statistic, np.maximum(used, 1)), 1.0)
    return Whiteness(tuple(columns), correlation, p_values)


def _correlation(
    r: Float[np.ndarray, "segments samples"], lags: int, num_fitted: float
) -> tuple[Float[np.ndarray, " lags"], Float[np.ndarray, " lags"]]:
    """Autocorrelation at each lag over all segments, and its number of pairs."""
    rho, count = np.full(lags, np.nan), np.zeros(lags)
    square = np.nanmean(r**2) if np.isfinite(r).any() else 0.0
    samples = max(float(np.isfinite(r).sum(1).mean()), 1.0)
    for lag in range(1, lags + 1):
        product = r[:, :-lag] * r[:, lag:]
        count[lag - 1] = np.isfinite(product).sum()
        if count[lag - 1] >= FEWEST and square > 0:
            rho[lag - 1] = np.nanmean(product) / square + min(num_fitted / samples, 0.5)
    return rho, count
