"""What columns that are added to a fit would earn, were predictions linear in their coefficients."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.evidence import profile
from det2stoc_bayes.optimize import Fit, noise_scale


@dataclass(frozen=True, eq=False)
class Addition:
    """Where the fit and the added coefficients go, and the evidence gained over the fit alone."""

    log_evidence: float  # nats
    gain: float  # drop of whitened squared residual
    coefficients: Float[np.ndarray, " columns"]
    change: Float[np.ndarray, " size"]  # of the current unknowns


def add(
    fit: Fit,
    gram: Float[np.ndarray, "k k"],
    slope: Float[np.ndarray, " k"],
    sd: Float[np.ndarray, " columns"],
    positive: Bool[np.ndarray, " columns"],
) -> Addition | None:
    """Closed-form evidence of [current unknowns, coefficients ~ N(0, sd)] against the current unknowns alone.

    `gram` and `slope` are J'J and J'r of the unknowns' columns and then the added ones. A coefficient that must be
    positive and would not be is left at 0; None where none is left.
    """
    size = fit.problem.size
    inside = np.ones(len(sd), bool)
    while inside.any():
        at = np.concatenate([np.ones(size, bool), inside])
        found = _unconstrained(fit, gram[np.ix_(at, at)], slope[at], sd[inside])
        coefficients = np.zeros(len(sd))
        coefficients[inside] = found.coefficients
        worst = int(np.argmin(np.where(positive, coefficients / sd, 0.0)))
        if not (positive[worst] and coefficients[worst] < 0):
            return Addition(found.log_evidence, found.gain, coefficients, found.change)
        inside[worst] = False
    return None


def _unconstrained(fit: Fit, gram: np.ndarray, slope: np.ndarray, sd: np.ndarray) -> Addition:
    size, z, s2 = fit.problem.size, fit.point.z, fit.noise_scale
    # Residuals were taken at the fit's optimum, where the prior pulls by -z.
    pull = np.concatenate([-z, np.zeros(len(sd))])
    prior = np.concatenate([np.ones(size), sd**-2.0])
    for _ in range(4):  # the noise scale and the coefficients determine each other
        precision = gram / s2 + np.diag(prior)
        step = np.linalg.solve(precision, slope / s2 + pull)
        chi2 = fit.chi2 - 2 * float(slope @ step) + float(step @ gram @ step)
        s2 = noise_scale(fit.linear, max(chi2, 1e-9), True)
    n = fit.linear.degrees_of_freedom
    penalty = float((prior[size:] * step[size:] ** 2).sum()) + float(((z + step[:size]) ** 2 - z**2).sum())
    occam = np.linalg.slogdet(precision)[1] + np.linalg.slogdet(fit.covariance)[1] - np.log(prior[size:]).sum()
    earned = profile(fit.chi2, fit.noise_scale, n) - profile(chi2, s2, n) - 0.5 * (penalty + float(occam))
    return Addition(float(earned), fit.chi2 - chi2, step[size:], step[:size])
