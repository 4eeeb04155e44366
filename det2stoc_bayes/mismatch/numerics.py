"""Whether the believed timestep is fine enough for what it is asked to predict."""

from dataclasses import dataclass, replace

import numpy as np

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.evidence import log_evidence
from det2stoc_bayes.optimize import Fit, fit_many

FINE = 4  # times finer, by RK4: the reference
RATIOS = (1, 2, 4)  # timesteps tried for "what converges", coarsest first
NEGLIGIBLE = 4.0  # whitened squared change of all samples that no evidence could come from


@dataclass(frozen=True, eq=False)
class Numerics:
    """A timestep and integrator that converge, and what they gain in evidence."""

    timestep: float
    integrator: str
    gain: float
    fit: Fit


def check_numerics(fit: Fit, timestep: float, num_candidates: int) -> Numerics | None:
    """The fit at a converged timestep, or None where integration error cannot matter or does not explain anything."""
    fine = timestep / FINE
    if _change(fit, fine, "RK4") < NEGLIGIBLE:
        return None
    better = _refit(fit, fine, "RK4")
    if better is None:
        return None
    gain = log_evidence(better) - log_evidence(fit)
    if gain < np.log(max(num_candidates, 1)):
        return None
    for ratio in RATIOS[:-1]:
        if _change(better, timestep / ratio, "RK4") < NEGLIGIBLE:
            coarser = _refit(better, timestep / ratio, "RK4")
            if coarser is not None:
                return Numerics(timestep / ratio, "RK4", log_evidence(coarser) - log_evidence(fit), coarser)
    return Numerics(fine, "RK4", gain, better)


def _at(fit: Fit, timestep: float, integrator: str):
    return replace(fit.problem, timestep=timestep, integrator=integrator)


def _change(fit: Fit, timestep: float, integrator: str) -> float:
    """Whitened squared change of the prediction that neither psi nor the starts can absorb."""
    lin, simulator = fit.linear, fit.problem.simulator
    z, start = fit.point.z[None], fit.point.start
    here = fit.problem.residuals(simulator.rollout(fit.problem.request(z, start)))
    there = fit.problem.residuals(simulator.rollout(_at(fit, timestep, integrator).request(z, start)))
    if not np.isfinite(there).all():
        return 0.0
    x = lin.latent.project(lin.latent.stack((here - there)[..., None]))[..., 0]
    j = lin.latent.project(lin.columns)
    slope = np.einsum("snk,sn->k", j, x)
    gram = np.einsum("snk,snl->kl", j, j) + np.eye(fit.problem.size)
    return float((x**2).sum() - (slope @ np.linalg.solve(gram, slope) if fit.problem.size else 0.0))


def _refit(fit: Fit, timestep: float, integrator: str) -> Fit | None:
    return fit_many([(_at(fit, timestep, integrator), Point(fit.point.z, fit.point.start))], tolerance=0.3)[0]
