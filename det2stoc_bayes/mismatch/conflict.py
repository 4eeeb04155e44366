"""Whether psi's priors are wrong, before any physics is said to be missing."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, log_told
from det2stoc_bayes.mismatch.horizon import reaches
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.priors import Prior
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import Parameter

TENSION = 3.0  # prior sds from the median at which a prior is doubted
WIDER = 10.0  # times
AS_WELL = 3.0  # nats


def resolved(fit: Fit) -> Fit | None:
    """The fit under priors ten times as wide, where some psi strains at its own and the recordings are explained then.

    None where no prior is in doubt, or where something else is missing, too.
    """
    if not strained(fit.problem, fit.point.z) or fit.problem.unknowns.varying:
        return None
    simulator = fit.problem.simulator
    parameters = tuple(_widened(p) for p in simulator.parameters)
    wide = Simulator(replace(simulator.study, parameters=parameters))
    found = _refitted(fit, wide, 5.0)
    return found if found is not None and found.noise_inflation < MODEL_ERROR else None


def needless(after: Fit, declared: Fit) -> bool:
    """Whether effects tell the recordings as well under the declared priors, none of which is in doubt beside them."""
    found = _refitted(after, declared.problem.simulator, 1.0)
    return (
        found is not None
        and not strained(found.problem, found.point.z)
        and bool(log_told(found) > log_told(after) - AS_WELL)
    )


def in_doubt(after: Fit, declared: Fit) -> bool:
    """Whether declared priors are in doubt beside effects that were found under wider ones."""
    return bool(strained(declared.problem, _z_under(after, declared.problem.simulator)))


def as_well(fit: Fit, other: Fit) -> bool:
    """Whether no more effects, beside which no prior is in doubt, tell the recordings as well as others do."""
    count = len(fit.problem.effects)
    if not 0 < count <= len(other.problem.effects) or strained(fit.problem, fit.point.z):
        return False
    if fit.problem.segments.extent != other.problem.segments.extent:
        return reaches(fit, other)
    return bool(log_told(fit) > log_told(other) - AS_WELL)


def _refitted(fit: Fit, simulator: Simulator, farthest: float) -> Fit | None:
    """The fit under other priors, from the same psi or at most `farthest` of their sds out."""
    z = np.clip(_z_under(fit, simulator), -farthest, farthest)
    z = np.concatenate([z, fit.point.z[fit.problem.num_psi :]])
    problem = replace(fit.problem, simulator=simulator)
    return fit_many([(problem, Point(z, fit.point.start))], max_iterations=20)[0]


def _z_under(fit: Fit, simulator: Simulator) -> Float[np.ndarray, " psi"]:
    """psi of a fit in sds of other priors."""
    psi = fit.problem.psi(fit.point.z)
    return np.array([float(p.prior.to_normal(v)) for p, v in zip(simulator.parameters, psi, strict=True)])


def strained(
    problem: Problem, z: Float[np.ndarray, " size"], sd: Float[np.ndarray, " size"] | float = 0.0
) -> list[str]:
    """Names of psi that lie far out in their priors, of one that varies its population's mean.

    By more than an `sd` of what is known of it: where recordings say nothing of one, a fit may end anywhere.
    """
    least = np.abs(z) - sd
    return [b.parameter.name for b in problem.unknowns.blocks if least[b.begin] > TENSION]


def _widened(parameter: Parameter) -> Parameter:
    """Ten times the spread about the same median; what could not be negative still cannot."""
    prior, sd = parameter.prior, parameter.prior.sd
    if not np.isfinite(sd):
        return parameter
    low, high = prior.support
    arguments = {"loc": float(prior.from_normal(np.array(0.0))), "scale": WIDER * sd}
    arguments |= {"low": 0.0} if low >= 0 else {"high": 0.0} if high <= 0 else {}
    family = "TruncatedNormal" if len(arguments) > 2 else "Normal"
    return replace(parameter, prior=Prior(family, arguments), declared=prior)


def tail_probability(parameter: Parameter, value: float) -> float:
    """Two-sided tail of a psi under the prior that its study declares."""
    prior = parameter.declared or parameter.prior
    return min(2 * float(norm.sf(abs(float(prior.to_normal(value))))), 1.0)
