"""Evidence of fitted hypotheses, and probabilities that follow from it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.optimize import Fit

MODEL_ERROR = 1.5  # noise inflation beyond which residuals are taken to be model error, correlated in time
PRIOR_OF_NONE = 0.5  # probability before the data that nothing more was left out


def whitened(fit: Fit) -> Float[np.ndarray, "segments samples columns"]:
    """Residuals over the noise sd, each segment's start being the one that explains most; NaN where not recorded."""
    lin, segments = fit.linear, fit.problem.segments
    r = lin.latent.project(lin.stacked)[:, : fit.problem.weight.shape[1], 0].reshape(segments.values.shape)
    return np.where(segments.observed, r, np.nan)


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
    n, lin = fit.linear.degrees_of_freedom, fit.linear
    return (
        -share * profile(fit.chi2, fit.noise_scale, n)
        - 0.5 * float(lin.point.z @ lin.point.z)
        + 0.5 * log_det(widened(fit, share))
    )


def left_out_chi2(
    gram: Float[np.ndarray, "segments k k"],
    slope: Float[np.ndarray, "segments k"],
    square: Float[np.ndarray, " segments"],
    owner: Int[np.ndarray, " segments"],
    pull: Float[np.ndarray, " k"],
    prior: Float[np.ndarray, " k"],
    s2: float,
) -> float:
    """Whitened squared error of every recording under unknowns that were fitted to the others, to first order.

    gram, slope and square are J'J, J'r and r'r about a point; the prior has precision `prior` and gradient `pull`
    there. What one recording alone would like, others that are left out do not confirm.
    """
    total = 0.0
    every_gram, every_slope = gram.sum(0), slope.sum(0)
    for r in np.unique(owner):
        mine = owner == r
        g, b = gram[mine].sum(0), slope[mine].sum(0)
        step = np.linalg.solve((every_gram - g) / s2 + np.diag(prior), (every_slope - b) / s2 + pull)
        total += float(square[mine].sum()) - 2 * float(b @ step) + float(step @ g @ step)
    return max(total, 1e-9)


def left_out_density(fit: Fit) -> float:
    """Log density of recordings left out in turn, the noise scale profiled, up to a common constant."""
    gram, slope, square = fit.linear.gram()
    n, z = fit.linear.degrees_of_freedom, fit.point.z
    owner = fit.problem.segments.recording
    chi2 = left_out_chi2(gram, slope, square, owner, -z, np.ones(len(z)), fit.noise_scale)
    return -profile(chi2, max(1.0, chi2 / n), n)


def confirms(fit: Fit) -> bool:
    """Whether recordings are left out to judge additions: under model error in-sample evidence favours flexibility."""
    return fit.noise_inflation > MODEL_ERROR and len(np.unique(fit.problem.segments.recording)) > 1


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
