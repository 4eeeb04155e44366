"""How far two sets of draws are apart: plain-array functions. The second set is the reference."""

import warnings

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.psis import thinned

Draws = Float[np.ndarray, "_ size"]
WIDTH, MOST_WIDTH = 10, 100  # hidden units an unknown, and in all, in each of two layers
MOST_EPOCHS = 10_000


def distances(draws: Draws, reference: Draws, worth: int) -> dict[str, float]:
    """The distances below by name, of errors the largest; C2ST of no more draws than they are `worth`."""
    return {
        "c2st": c2st(thinned(draws, worth), reference),  # it takes draws that hang together for a cluster
        "wasserstein": sliced_wasserstein(draws, reference),
        "mean_error": float(np.abs(mean_errors(draws, reference)).max()),
        "sd_error": float(np.abs(sd_errors(draws, reference)).max()),
    }


def c2st(draws: Draws, reference: Draws, *, seed: int = 1, num_folds: int = 5) -> float:
    """Accuracy of a classifier that tells the two sets apart, cross-validated: 0.5 where none can.

    The network of Lueckmann et al. (2021), no wider than for ten unknowns: two hidden layers, inputs in units of the
    first set; of the larger set as many draws as the smaller one has.
    """
    from sklearn.model_selection import KFold, cross_val_score
    from sklearn.neural_network import MLPClassifier

    count, size = min(len(draws), len(reference)), draws.shape[1]
    center, scale = draws.mean(0), draws.std(0, ddof=1)
    scale = np.where(scale > 0, scale, 1.0)
    both = np.concatenate([thinned(draws, count), thinned(reference, count)])
    width = min(WIDTH * size, MOST_WIDTH)
    network = MLPClassifier((width, width), max_iter=MOST_EPOCHS, random_state=seed)
    folds = KFold(num_folds, shuffle=True, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a network that has not converged tells apart less
        told = cross_val_score(network, (both - center) / scale, np.repeat([0, 1], count), cv=folds, scoring="accuracy")
    return float(told.mean())


def sliced_wasserstein(draws: Draws, reference: Draws, *, seed: int = 0, num_directions: int = 200) -> float:
    """Mean over random directions of the distance between projections, in the reference's sds (Bonneel et al. 2015)."""
    random = np.random.default_rng(seed)
    direction = random.standard_normal((draws.shape[1], num_directions))
    direction /= np.linalg.norm(direction, axis=0) * reference.std(0)[:, None]
    level = (np.arange(1000) + 0.5) / 1000
    a, b = (np.quantile(d @ direction, level, axis=0) for d in (draws, reference))
    return float(np.abs(a - b).mean())


def gaussian_kl(draws: Draws, mean: Float[np.ndarray, " size"], covariance: Float[np.ndarray, "size size"]) -> float:
    """KL(N(draws' moments) || N(mean, covariance)) [nat]."""
    off, own = draws.mean(0) - mean, np.atleast_2d(np.cov(draws.T))
    inner = np.linalg.solve(covariance, own)
    distance = off @ np.linalg.solve(covariance, off)
    return float(0.5 * (np.trace(inner) + distance - len(mean) - np.linalg.slogdet(inner)[1]))


def mean_errors(draws: Draws, reference: Draws) -> Float[np.ndarray, " size"]:
    """Distance between means in the reference's sds."""
    return (draws.mean(0) - reference.mean(0)) / reference.std(0, ddof=1)


def sd_errors(draws: Draws, reference: Draws) -> Float[np.ndarray, " size"]:
    """Relative error of the sds."""
    return draws.std(0, ddof=1) / reference.std(0, ddof=1) - 1
