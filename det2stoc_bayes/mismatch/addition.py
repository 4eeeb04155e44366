"""What columns that are added to a fit would earn, were predictions linear in their coefficients."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.evidence import profile
from det2stoc_bayes.newton import noise_scale
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.problem import FARTHEST


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

    `gram` and `slope` are J'J and J'r of the unknowns' columns and then the added ones. A psi stays within its prior's
    support, and a coefficient that must be positive and would not be is left out; None where none is left.
    """
    size = fit.problem.size
    down, up = _room(fit)
    low = np.concatenate([down, np.where(positive, 0.0, -np.inf)])
    high = np.concatenate([up, np.full(len(positive), np.inf)])
    held = np.full(len(slope), np.nan)  # values of what stays at its bound
    while np.isnan(held[size:]).any():
        step, chi2, s2 = _solved(fit, gram, slope, sd, held)
        beyond = np.maximum(low - step, step - high) / np.concatenate([np.ones(size), sd])
        worst = int(np.argmax(np.where(np.isnan(held), beyond, -np.inf)))
        if not beyond[worst] > 0:
            return _weighed(fit, gram, step, chi2, s2, sd, held)
        held[worst] = low[worst] if step[worst] < low[worst] else high[worst]
    return None


@lru_cache(maxsize=4)  # thousands of pairs are added to one fit
def _room(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """How far each unknown may go down and up, were psi linear in it."""
    problem, z = fit.problem, fit.point.z
    straight, psi = problem.straightener(z), [b.begin for b in problem.unknowns.blocks]
    low, high = np.full(problem.size, -np.inf), np.full(problem.size, np.inf)
    for end, sign in ((low, -1), (high, 1)):
        far = np.array(z)
        far[psi] = sign * np.maximum(FARTHEST, np.abs(z[psi]))
        end[psi] = straight(far)[psi]
    return np.maximum(low, np.minimum(problem.floor - z, 0.0)), high


def _solved(fit: Fit, gram: np.ndarray, slope: np.ndarray, sd: np.ndarray, held: np.ndarray):
    """The step under the noise scale that it leads to, its chi2, and that scale."""
    # Residuals were taken at the fit's optimum, where the prior pulls by -z.
    pull = np.concatenate([-fit.point.z, np.zeros(len(sd))])
    prior = np.concatenate([np.ones(fit.problem.size), sd**-2.0])
    free, step, s2 = np.isnan(held), np.nan_to_num(held), fit.noise_scale
    for _ in range(4):  # the noise scale and the coefficients determine each other
        target = slope / s2 + pull - (gram / s2) @ np.where(free, 0.0, step)
        precision = (gram / s2 + np.diag(prior))[np.ix_(free, free)]
        step[free] = np.linalg.solve(precision, target[free])
        chi2 = fit.chi2 - 2 * float(slope @ step) + float(step @ gram @ step)
        s2 = noise_scale(fit.linear, max(chi2, 1e-9), True)
    return step, chi2, s2


def _weighed(fit: Fit, gram: np.ndarray, step, chi2: float, s2: float, sd: np.ndarray, held) -> Addition:
    size, z, n = fit.problem.size, fit.point.z, fit.linear.degrees_of_freedom
    free = np.isnan(held[size:])
    at = np.concatenate([np.ones(size, bool), free])  # an unknown at its bound is no better known for that
    precision = (gram / s2 + np.diag(np.concatenate([np.ones(size), sd**-2.0])))[np.ix_(at, at)]
    penalty = float(((step[size:] / sd) ** 2).sum()) + float(((z + step[:size]) ** 2 - z**2).sum())
    occam = np.linalg.slogdet(precision)[1] + np.linalg.slogdet(fit.covariance)[1] + 2 * np.log(sd[free]).sum()
    earned = profile(fit.chi2, fit.noise_scale, n) - profile(chi2, s2, n) - 0.5 * (penalty + float(occam))
    return Addition(float(earned), fit.chi2 - chi2, step[size:], step[:size])
