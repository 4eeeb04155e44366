"""Statistics of draws on plain arrays: Pareto-smoothed weights (Vehtari et al., 2024), standard errors, stacking."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.optimize import minimize
from scipy.special import logsumexp

LEAST_DRAWS = 25  # fewer have no tail to speak of


def reliable(num_draws: int) -> float:
    """k-hat beyond which weighted averages are not to be trusted: 0.7, less for few draws."""
    return min(1.0 - 1.0 / np.log10(max(num_draws, 11)), 0.7)


def smooth(log_weights: Float[np.ndarray, " draws"]) -> tuple[Float[np.ndarray, " draws"], float]:
    """Normalized log weights with the largest smoothed, and k-hat: the tail's shape, infinite where it has none."""
    from arviz_stats.base.array import array_stats

    log_weights = np.asarray(log_weights, dtype=float)
    finite = np.isfinite(log_weights)
    out = np.full(len(log_weights), -np.inf)
    if finite.sum() < LEAST_DRAWS:
        out[finite] = log_weights[finite] - logsumexp(log_weights[finite]) if finite.any() else 0.0
        return out, np.inf
    if np.ptp(log_weights[finite]) < 1e-9:  # equal weights have no tail
        out[finite] = -np.log(finite.sum())
        return out, -np.inf
    stats: Any = array_stats
    smoothed, k_hat = stats.psislw(-log_weights[finite])
    out[finite] = smoothed - logsumexp(smoothed)
    return out, np.inf if np.isnan(k_hat) else float(k_hat)  # all the weight is on a few


def effective_draws(weights: Float[np.ndarray, " draws"]) -> float:
    """How many draws of equal weight would tell as much; 0 where none has any."""
    return float(weights.sum() ** 2 / (weights**2).sum()) if weights.any() else 0.0


def thinned(draws: Shaped[np.ndarray, "_ ..."], count: int) -> Shaped[np.ndarray, "_ ..."]:
    """At most so many rows, evenly spread over the set."""
    return draws[np.linspace(0, len(draws) - 1, min(count, len(draws))).round().astype(int)]


def resampled(
    weights: Float[np.ndarray, " draws"], count: int, random: np.random.Generator
) -> Int[np.ndarray, " count"]:
    """Rows in random order, each as often as its weight wants, give or take one: systematic resampling."""
    at = (np.arange(count) + random.random()) / count
    rows = np.searchsorted(np.cumsum(weights) / weights.sum(), at)
    return random.permutation(np.minimum(rows, len(weights) - 1))


def leave_one_out(log_likelihood: Float[np.ndarray, "chain draw recordings"]) -> tuple[float, float | None, float]:
    """Expected log density of left-out recordings, its standard error over them, and the worst k-hat (PSIS-LOO)."""
    terms = log_likelihood.reshape(-1, log_likelihood.shape[-1])
    scores, k_hats = [], []
    for column in terms.T:
        log_weights, k_hat = smooth(-column)
        scores.append(float(np.logaddexp.reduce(log_weights + column) - np.logaddexp.reduce(log_weights)))
        k_hats.append(k_hat)
    error = float(np.std(scores, ddof=1) * np.sqrt(len(scores))) if len(scores) > 1 else None
    return float(np.sum(scores)), error, max(k_hats)


def standard_errors(draws: Float[np.ndarray, "chain draw size"]) -> Float[np.ndarray, " size"]:
    """Monte-Carlo standard errors of the means of chains."""
    from arviz_stats.base.array import array_stats

    stats: Any = array_stats
    return np.array([float(stats.mcse(column, method="mean")) for column in np.moveaxis(draws, -1, 0)])


def r_hats(draws: Float[np.ndarray, "chain draw size"]) -> Float[np.ndarray, " size"]:
    """Rank-normalized split R-hat of each unknown: about 1 where chains agree."""
    from arviz_stats.base.array import array_stats

    stats: Any = array_stats
    return np.array([float(stats.rhat(column)) for column in np.moveaxis(draws, -1, 0)])


def bfmi(energy: Float[np.ndarray, "chain draw"]) -> float:
    """The worst chain's share of the energy's variance that one step moves through (Betancourt 2016)."""
    from arviz_stats.base.array import array_stats

    stats: Any = array_stats
    return float(np.min(stats.bfmi(energy)))


def stacking_weights(log_density: Float[np.ndarray, "recordings models"]) -> Float[np.ndarray, " models"]:
    """Weights on the simplex that maximize sum log sum_m w_m p_m (Yao et al., 2018).

    Each row is scaled by its largest entry, without which densities of long recordings would all underflow to 0.
    """
    log_density = np.asarray(log_density, dtype=float)
    count = log_density.shape[1]
    p = np.exp(np.maximum(log_density - log_density.max(1, keepdims=True), -700.0))

    def loss(w):
        mixed = p @ w
        return -np.log(mixed).sum(), -(p / mixed[:, None]).sum(0)

    found = minimize(
        loss,
        np.full(count, 1 / count),
        jac=True,
        method="SLSQP",
        bounds=[(1e-9, 1.0)] * count,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0, "jac": lambda w: np.ones(count)},
    )
    w = np.clip(found.x, 0.0, 1.0)
    return w / w.sum()
