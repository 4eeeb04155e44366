"""Evidence of fitted hypotheses, and probabilities that follow from it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.optimize import Fit

MODEL_ERROR = 1.5  # noise inflation beyond which residuals are taken to be model error, correlated in time
CHANCE = 3.0  # standard deviations of chi2 by which an error exceeds noise by chance
PRIOR_OF_NONE = 0.5  # probability before the data that nothing more was left out


def whitened(fit: Fit) -> Float[np.ndarray, "segments samples columns"]:
    """Residuals over the noise sd, each segment's start being the one that explains most; NaN where not recorded."""
    lin, segments = fit.linear, fit.problem.segments
    r = lin.latent.project(lin.stacked)[:, : fit.problem.weight.shape[1], 0].reshape(segments.values.shape)
    return np.where(segments.observed, r, np.nan)


def by_chance(fit: Fit) -> bool:
    """Whether noise alone may well have made what a fit leaves."""
    return bool(fit.noise_inflation - 1 < CHANCE * np.sqrt(2 / fit.linear.degrees_of_freedom))


def effective_share(fit: Fit) -> float:
    """Independent samples per sample, from the residuals' autocorrelation; 1 while the misfit is within the noise.

    Errors of a model persist from sample to sample, and counting every sample would make any improvement certain.
    """
    if fit.noise_inflation < MODEL_ERROR:
        return 1.0
    r = np.nan_to_num(whitened(fit))
    energy = (r**2).sum((0, 1))
    times = []
    for j in range(r.shape[2]):
        x = r[:, :, j]
        size = 2 ** int(np.ceil(np.log2(2 * x.shape[1])))
        spectrum = (np.abs(np.fft.rfft(x, size, axis=1)) ** 2).sum(0)
        rho = np.fft.irfft(spectrum)[: x.shape[1]]
        rho = rho / max(rho[0], 1e-300)
        pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(1)  # Geyer's initial positive sequence
        stop = int(np.argmax(pairs < 0)) if (pairs < 0).any() else len(pairs)
        times.append(max(2 * float(pairs[:stop].sum()) - 1.0, 1.0))
    return float(1.0 / np.average(times, weights=np.maximum(energy, 1e-12)))


def log_evidence(fit: Fit, share: float = 1.0) -> float:
    """Laplace's approximation of log p(recordings | hypothesis), the noise scale profiled, up to a common constant.

    `share` is the number of independent samples per sample (`effective_share`).
    """
    z = fit.point.z
    return share * log_told(fit) - 0.5 * float(z @ z) + 0.5 * log_det(widened(fit, share))


def log_told(fit: Fit) -> float:
    """Log density of the recordings at a fit, the noise scale profiled, up to a common constant."""
    return -profile(fit.chi2, fit.noise_scale, fit.linear.degrees_of_freedom)


def profile(chi2: float, s2: float, n: int) -> float:
    """Negative log likelihood of a whitened misfit under noise widened by s2, up to a constant."""
    return 0.5 * n * np.log(s2) + 0.5 * chi2 / s2


def widened(fit: Fit, share: float) -> Float[np.ndarray, "size size"]:
    """Covariance of z when only a share of the samples is independent."""
    eye = np.eye(fit.problem.size)
    data = np.linalg.inv(fit.covariance) - eye
    return np.linalg.inv(share * data + eye)


def log_det(matrix: np.ndarray) -> float:
    """log |matrix|."""
    return float(np.linalg.slogdet(matrix)[1]) if matrix.size else 0.0


def probabilities(gains: Sequence[float], num_candidates: int) -> Float[np.ndarray, " hypotheses"]:
    """Posterior probability of each hypothesis, given log evidence gains over none; what is left is none's.

    Every one of `num_candidates` candidates, refined or not, has the same share of 1 - PRIOR_OF_NONE.
    """
    prior = np.log((1 - PRIOR_OF_NONE) / max(num_candidates, 1))
    logits = np.array([np.log(PRIOR_OF_NONE), *(prior + np.asarray(gains, float))])
    weights = np.exp(logits - logits.max())
    return (weights / weights.sum())[1:]
