"""How much a psi differs from recording to recording: the maximum of sigma's marginal posterior about a fit.

Mode-seeking over sigma and the recordings' own values together would favour a wide population of values that all
sit at its centre; with the values integrated out (Laplace) sigma has an honest maximum.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from det2stoc_bayes.errors import SimulationDiverged
from det2stoc_bayes.linearization import Point
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.unknowns import LEAST_SPREAD

LARGEST_FACTOR = 5.0  # by which sigma moves at once
SETTLED = 0.02  # relative change of sigma that no longer matters
CURVATURE_STEP = 0.1  # of log sigma


def log_marginal(fit: Fit, log_factor: Float[np.ndarray, " varying"]) -> float:
    """log p(recordings | sigma) + log prior of log sigma, about a fit and up to a constant; sigma = factor * held."""
    problem, z = fit.problem, fit.point.z
    gram, slope, _ = (x.sum(0) / fit.noise_scale for x in fit.linear.gram())
    prior_sd = np.ones(problem.size)
    for rows, change in zip(problem.unknowns.own, log_factor, strict=True):
        prior_sd[rows] = np.exp(change)
    precision = gram + np.diag(prior_sd**-2)
    pull = slope + gram @ z
    value = 0.5 * pull @ np.linalg.solve(precision, pull) - 0.5 * np.linalg.slogdet(precision)[1]
    value -= float(np.log(prior_sd).sum())
    for block, change in zip(problem.unknowns.varying, log_factor, strict=True):
        sigma, scale = float(block.spread or 0.0) * np.exp(change), block.parameter.prior.sd / 2
        value += np.log(sigma) - 0.5 * (sigma / scale) ** 2
    return float(value)


def better_spreads(fit: Fit) -> tuple[float, ...] | None:
    """sigma of each varying psi at the marginal's maximum; None where the held ones are as good."""
    varying, held = fit.problem.unknowns.varying, fit.problem.spreads
    if not varying or held is None:
        return None
    low = [
        np.log(max(LEAST_SPREAD * b.parameter.prior.sd / s, 1 / LARGEST_FACTOR))
        for b, s in zip(varying, held, strict=True)
    ]
    bounds = [(min(a, 0.0), np.log(LARGEST_FACTOR)) for a in low]
    found = minimize(lambda x: -log_marginal(fit, x), np.zeros(len(varying)), bounds=bounds, method="L-BFGS-B")
    if np.abs(found.x).max() < SETTLED:
        return None
    return tuple(float(s * np.exp(x)) for s, x in zip(held, found.x, strict=True))


def respread(fit: Fit, spreads: tuple[float, ...] | None) -> tuple[Problem, Point]:
    """The same point under other spreads (None: as unknowns): every recording keeps its value."""
    problem = replace(fit.problem, spreads=spreads)
    return problem, Point(fit.problem.carry(fit.point.z, problem), fit.point.start)


def freed(fit: Fit) -> Fit:
    """The same point with the spreads among the unknowns."""
    found = fit_many([respread(fit, None)], max_iterations=0, free_scale=False)[0]
    if found is None:  # it was finite a moment ago
        raise SimulationDiverged("the simulation at the most probable parameters does not stay finite")
    return found


def log_spread_sd(fit: Fit) -> Float[np.ndarray, " varying"]:
    """sd of each log sigma, from the marginal's curvature at its maximum; at most that of its prior (1.1)."""
    count = len(fit.problem.unknowns.varying)
    out, middle = np.empty(count), log_marginal(fit, np.zeros(count))
    for k in range(count):
        step = CURVATURE_STEP * np.eye(count)[k]
        bend = (2 * middle - log_marginal(fit, step) - log_marginal(fit, -step)) / CURVATURE_STEP**2
        out[k] = 1 / np.sqrt(max(bend, 1 / 1.1**2))
    return out
