"""Whether posteriors of many simulated data sets hold their truths as often as they say: plain-array functions."""

from bisect import bisect_left

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

Truths = Float[np.ndarray, "replications size"]
Draws = Float[np.ndarray, "replications draws size"]
NUM_BINS = 20
NUM_SIMULATED = 2000
POWER, NUM_REPEATED = 0.8, 400
SHIFTS = np.round(np.geomspace(0.02, 5.0, 80), 3)  # sds of a posterior
FACTORS = np.round(np.geomspace(1.02, 20.0, 80), 3)  # times that posteriors are too narrow


def ranks(draws: Draws, truth: Truths) -> Int[np.ndarray, "replications size"]:
    """How many draws lie below the truth: uniform on 0 .. draws (Talts et al. 2018, algorithm 1), if independent."""
    return (draws < truth[:, None]).sum(1)


def rank_p_values(ranks: Int[np.ndarray, "replications size"], num_draws: int) -> Float[np.ndarray, " size"]:
    """p-value of each unknown's ranks under uniformity: chi-squared over bins of as equal a width as ranks allow."""
    bins = num_bins(len(ranks), num_draws)
    edges = np.linspace(0, num_draws + 1, bins + 1).round().astype(int)
    expected = np.diff(edges) / (num_draws + 1) * len(ranks)
    counts = np.stack([np.histogram(column, edges - 0.5)[0] for column in ranks.T])
    return stats.chi2.sf((np.square(counts - expected) / expected).sum(1), bins - 1)


def num_bins(replications: int, num_draws: int) -> int:
    """Bins of a histogram of ranks: five replications each at least."""
    return min(NUM_BINS, num_draws + 1, max(replications // 5, 2))


def fractions(
    ranks: Int[np.ndarray, "replications size"], num_draws: int, random: np.random.Generator
) -> Float[np.ndarray, "replications size"]:
    """Ranks as shares of 1, ties broken at random: uniform on (0, 1) where the ranks are."""
    return (ranks + random.uniform(size=ranks.shape)) / (num_draws + 1)


def uniform_p_values(fractions: Float[np.ndarray, "replications size"]) -> Float[np.ndarray, " size"]:
    """p-value of each column under uniformity (Kolmogorov and Smirnov)."""
    return np.array([stats.kstest(column, "uniform").pvalue for column in fractions.T])


def detectable(count: int, p_value: float, random: np.random.Generator) -> tuple[float | None, float | None]:
    """The least shift (posterior sds) and narrowness (times) of normal posteriors that a test of uniformity finds.

    Kolmogorov and Smirnov's, at this p-value, of so many replications, in POWER of all cases; None where none is found.
    """
    truth = random.standard_normal((NUM_REPEATED, count))
    needed = float(stats.kstwo.isf(p_value, count))

    def found(wrong: Float[np.ndarray, "cases count"]) -> bool:
        return bool((_distance(stats.norm.cdf(wrong)) > needed).mean() >= POWER)

    shift = bisect_left(SHIFTS, True, key=lambda size: found(truth + size))
    factor = bisect_left(FACTORS, True, key=lambda size: found(truth * size))
    return (*SHIFTS.tolist(), None)[shift], (*FACTORS.tolist(), None)[factor]


def _distance(values: Float[np.ndarray, "cases count"]) -> Float[np.ndarray, " cases"]:
    """Largest distance of each row's empirical distribution from the uniform one."""
    order, count = np.sort(values, 1), values.shape[1]
    above, below = np.arange(1, count + 1) / count - order, order - np.arange(count) / count
    return np.maximum(above, below).max(1)


def holm(p_values: Float[np.ndarray, " tests"]) -> Float[np.ndarray, " tests"]:
    """p-values corrected for their number (Holm 1979): the least is below a level by chance as often as that says."""
    order = np.argsort(p_values)
    corrected = np.maximum.accumulate(np.arange(len(p_values), 0, -1) * p_values[order])
    return np.minimum(corrected, 1.0)[np.argsort(order)]


def ecdf_band(
    count: int, level: Float[np.ndarray, " levels"], confidence: float, random: np.random.Generator
) -> Float[np.ndarray, "2 levels"]:
    """Bounds within which the whole empirical distribution of `count` uniform numbers stays (Sailynoja et al. 2022).

    They are binomial quantiles at one probability everywhere, which simulated samples set.
    """
    simulated = random.uniform(size=(NUM_SIMULATED, count))
    below = np.stack([(simulated <= at).sum(1) for at in level], 1)
    tails = np.minimum(stats.binom.cdf(below, count, level), stats.binom.sf(below - 1, count, level))
    least = np.quantile(tails.min(1), 1 - confidence)
    return np.stack([stats.binom.ppf(least, count, level), stats.binom.isf(least, count, level)]) / count


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
