"""Whether posteriors of many simulated data sets hold their truths as often as they say: plain-array functions."""

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

Truths = Float[np.ndarray, "replications size"]
Draws = Float[np.ndarray, "replications draws size"]
NUM_BINS = 20


def ranks(draws: Draws, truth: Truths) -> Int[np.ndarray, "replications size"]:
    """How many draws lie below the truth: uniform on 0 .. draws (Talts et al. 2018, algorithm 1), if independent."""
    return (draws < truth[:, None]).sum(1)


def rank_p_values(ranks: Int[np.ndarray, "replications size"], num_draws: int) -> Float[np.ndarray, " size"]:
    """p-value of each unknown's ranks under uniformity: chi-squared over bins of as equal a width as ranks allow."""
    bins = min(NUM_BINS, num_draws + 1, max(len(ranks) // 5, 2))
    edges = np.linspace(0, num_draws + 1, bins + 1).round().astype(int)
    expected = np.diff(edges) / (num_draws + 1) * len(ranks)
    counts = np.stack([np.histogram(column, edges - 0.5)[0] for column in ranks.T])
    return stats.chi2.sf((np.square(counts - expected) / expected).sum(1), bins - 1)


def credibilities(draws: Draws, truth: Truths, random: np.random.Generator) -> Float[np.ndarray, " replications"]:
    """TARP: share of draws nearer than the truth to a random point; uniform if calibrated (Lemos et al. 2023).

    Distances are in the sds of all truths, the points uniform over their box. Ties count in part, at random.
    """
    scale = truth.std(0)
    low, high = truth.min(0), truth.max(0)
    point = random.uniform(low, high, truth.shape)
    apart = np.linalg.norm((draws - point[:, None]) / scale, axis=-1)
    own = np.linalg.norm((truth - point) / scale, axis=-1)[:, None]
    below = (apart < own).sum(1) + random.uniform(size=len(truth)) * (1 + (apart == own).sum(1))
    return below / (draws.shape[1] + 1)


def expected_coverage(
    credibility: Float[np.ndarray, " replications"], level: Float[np.ndarray, " levels"]
) -> Float[np.ndarray, " levels"]:
    """How often the truth lies within regions of these credible levels."""
    return (credibility[:, None] < level).mean(0)


def coverage_p_value(credibility: Float[np.ndarray, " replications"]) -> float:
    """p-value of credibilities under uniformity (Kolmogorov and Smirnov)."""
    return float(stats.kstest(credibility, "uniform").pvalue)
