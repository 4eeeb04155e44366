"""How good a distribution over next states is, from its draws: plain-array functions."""

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.special import logsumexp

FLOOR = 1e-5  # sd of a matched Gaussian in every dimension, raw units


def matched_log_density(
    draws: Float[np.ndarray, "draws points size"],
    true: Float[np.ndarray, "points size"],
    floor: float | Float[np.ndarray, " size"] = FLOOR,
) -> Float[np.ndarray, " points"]:
    """log density of the diagonal Gaussian with the draws' moments, summed over dimensions."""
    return gaussian_log_density(true - draws.mean(0), draws.std(0), floor)


def gaussian_log_density(
    off: Float[np.ndarray, "points size"],
    sd: Float[np.ndarray, "points size"],
    floor: float | Float[np.ndarray, " size"] = FLOOR,
) -> Float[np.ndarray, " points"]:
    """log density of a diagonal Gaussian at a distance from its mean, its sd at least the floor."""
    sd = np.maximum(sd, floor)
    return (-0.5 * (off / sd) ** 2 - np.log(sd) - 0.5 * np.log(2 * np.pi)).sum(-1)


def mixture_log_density(terms: Float[np.ndarray, "draws points"]) -> Float[np.ndarray, " points"]:
    """log of the mean over latents of p(y | x, z)."""
    return logsumexp(terms, axis=0) - np.log(len(terms))


def energy_score(
    draws: Float[np.ndarray, "draws points size"], true: Float[np.ndarray, "points size"]
) -> Float[np.ndarray, " points"]:
    """E|X - y| - E|X - X'| / 2 (Gneiting and Raftery 2007, eq. 21); less is better."""
    half = len(draws) // 2
    near = np.linalg.norm(draws - true, axis=-1).mean(0)
    return near - 0.5 * np.linalg.norm(draws[:half] - draws[half : 2 * half], axis=-1).mean(0)


def pit(
    draws: Float[np.ndarray, "draws points size"], true: Float[np.ndarray, "points size"]
) -> Float[np.ndarray, "points size"]:
    """Share of draws below the truth, in every dimension: uniform if the draws are right."""
    return (draws < true).mean(0) + 0.5 * (draws == true).mean(0)


def uniform_distance(ranks: Float[np.ndarray, " points"]) -> float:
    """Greatest distance between the distribution of ranks and the uniform one (Kolmogorov)."""
    return float(stats.kstest(ranks, "uniform").statistic)


def gaussian_divergence(mean: float, sd: float, other_mean: float, other_sd: float) -> float:
    """KL(N(mean, sd) || N(other_mean, other_sd)) [nat]."""
    ratio = sd / other_sd
    return float(0.5 * (ratio**2 + ((mean - other_mean) / other_sd) ** 2 - 1) - np.log(ratio))
