"""Whether the believed timestep is fine enough for what it is asked to predict."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, by_chance, effective_share, log_evidence, profile
from det2stoc_bayes.mismatch.race import threshold
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.problem import Finer, Problem

FINE = 4  # times finer, by RK4: the reference
RATIOS = (1, 2, 4)  # timesteps tried for "what converges", coarsest first
SHORTER = (2, 4, 5, 8, 10, 16)  # times: steps of the believed integrator by which recordings may have been simulated
LITTLE = 0.05  # of what a fit leaves beyond the noise, the most that steps of what was recorded leave
NEAR = 50.0  # nats behind the best within which an error of integration may decide in any case
MOST_COMPARED = 5
NEGLIGIBLE = 4.0  # whitened squared change of all samples that no evidence could come from


@dataclass(frozen=True, eq=False)
class Numerics:
    """A timestep and integrator that converge, what they gain in evidence, and the believed model's fit under them.

    Where they were found beside effects the gain is that there. `simulated`: they do not converge, but are those by
    which what was recorded seems to have been simulated.
    """

    timestep: float
    integrator: str
    gain: float
    fit: Fit
    simulated: bool = False


def check_numerics(fit: Fit, timestep: float, num_candidates: int) -> Numerics | None:
    """The fit at a converged timestep, or None where integration error cannot matter or does not explain anything."""
    found = _converged(fit, timestep)
    if found is None:
        return None
    step, integrator, _ = found
    better = by_steps(fit, step, integrator)
    if better is None:
        return None
    share = effective_share(better)
    gain = log_evidence(better, share) - log_evidence(fit, share)
    return Numerics(step, integrator, gain, better) if gain > threshold(num_candidates) else None


def simulated(fit: Fit, timestep: float, num_candidates: int, gained: float = 0.0) -> Numerics | None:
    """The same hypothesis by shorter steps of the believed integrator, where these leave next to nothing; else None.

    What was recorded of another simulation has that one's error, which no converged one has. `gained` is what the
    steps of the fit gain already. Which ones serve is foretold to first order, and whether they do by a fit.
    """
    if by_chance(fit):
        return None
    own, here = fit.problem.simulator.integrator, _predicted(fit)
    left = {n: _chi2_with(fit, here, _predicted(fit, timestep / n, own)) for n in SHORTER}
    times = min(left, key=left.__getitem__)
    noise = fit.problem.measurement.mean_square * fit.linear.degrees_of_freedom
    if left[times] >= 0.5 * (fit.chi2 + noise):
        return None
    found = by_steps(fit, timestep / times, own)
    if found is None:
        return None
    beyond = found.noise_inflation - 1
    little = found.noise_inflation < MODEL_ERROR and beyond < LITTLE * (fit.noise_inflation - 1)
    share = effective_share(found)
    gain = gained + log_evidence(found, share) - log_evidence(fit, share)
    told = (little or by_chance(found)) and gain > threshold(num_candidates)
    return Numerics(timestep / times, own, gain, found, simulated=True) if told else None


def by_steps(fit: Fit, timestep: float | None, integrator: str | None) -> Fit | None:
    """The same hypothesis under another integration, None: the believed one; None where that cannot follow."""
    return fit_many([(_at(fit, timestep, integrator), fit.point)], tolerance=0.3)[0]


def of_believed(found: Numerics, believed: Fit) -> Numerics | None:
    """What was found beside effects, with the believed model's own fit; None where that cannot follow."""
    better = by_steps(believed, found.timestep, found.integrator)
    return None if better is None else replace(found, fit=better)


def converging(fit: Fit, numerics: Numerics | None) -> tuple[Fit, Numerics | None]:
    """A fit at a finer step, and what is told of that, by steps that converge for this very fit over its stretches.

    Those by which what was recorded was simulated stay, and those that recordings prefer.
    """
    if numerics is not None and numerics.simulated:
        return fit, numerics
    step = fit.problem.timestep
    found = None if step is None else _converged(fit, step, _moved)
    if found is None or _promise(fit, found[2]) < -threshold(1):
        return fit, numerics
    better = by_steps(fit, found[0], found[1])
    if better is None:
        return fit, numerics
    if numerics is not None:
        plain = by_steps(numerics.fit, found[0], found[1]) or numerics.fit
        numerics = replace(numerics, timestep=found[0], integrator=found[1], fit=plain)
    return better, numerics


def held_error(fit: Fit) -> Fit:
    """A fit at a finer step as one at the believed step, whose error is held as it is there."""
    plain, own = _at(fit, None, None), fit.problem
    if own.timestep is None or own.integrator is None:
        return fit
    here = plain.simulator.rollout(plain.request(fit.point.z[None], fit.point.start))
    shifted = replace(plain, finer=Finer(own.timestep, own.integrator, _predicted(fit) - here))
    return fit_many([(shifted, fit.point)], tolerance=0.3)[0] or fit


def corrected(fit: Fit) -> Fit:
    """The fit without the believed timestep's error, where recordings are explained so well that it matters.

    The error is taken from one finer simulation and held, so that all that follows costs what it did.
    """
    return comparable([fit])[0]


def comparable(fits: Sequence[Fit]) -> list[Fit]:
    """Rival fits, the best and those near it without the believed timestep's error if the best is better for it.

    All that may be best then or none: an error of integration may be what favours one of two that hardly differ.
    """
    evidence = np.array([log_evidence(f) for f in fits])
    best = fits[int(evidence.argmax())]
    if best.problem.timestep is not None or best.noise_inflation >= MODEL_ERROR:
        return list(fits)
    reach = evidence + np.maximum([0.5 * _excess(f) for f in fits], NEAR)
    near = [i for i in np.argsort(-evidence) if reach[i] > evidence.max()][:MOST_COMPARED]
    without = dict(zip(near, _without_error([fits[i] for i in near]), strict=True))
    if max(log_evidence(f) for f in without.values()) <= evidence.max():
        return list(fits)
    return [without.get(i, f) for i, f in enumerate(fits)]


def _excess(fit: Fit) -> float:
    """What chi2 is more than noise makes it: nothing gains more than half of it in log likelihood."""
    return (fit.noise_inflation - 1) * fit.linear.degrees_of_freedom


def _without_error(fits: Sequence[Fit]) -> list[Fit]:
    """Fits with the held error of the believed timestep taken off; as they are where it decides nothing."""
    found = [_converged(f, float(f.problem.simulator.model.opt.timestep)) for f in fits]
    promised = [log_evidence(f) + (0.0 if c is None else _promise(f, c[2])) for f, c in zip(fits, found, strict=True)]
    shifted = {
        i: replace(fits[i].problem, finer=Finer(*c))
        for i, c in enumerate(found)
        if c is not None and promised[i] > max(promised) - NEAR
    }
    again = fit_many([(p, fits[i].point) for i, p in shifted.items()], tolerance=0.3) if shifted else []
    better = dict(zip(shifted, again, strict=True))
    return [better.get(i) or f for i, f in enumerate(fits)]


def _converged(
    fit: Fit, timestep: float, size: Callable[[Fit, np.ndarray, np.ndarray], float] | None = None
) -> tuple[float, str, Float[np.ndarray, "segments samples columns"]] | None:
    """The coarsest step by RK4 that predicts as the finest, and what it adds; None where it hardly differs by `size`.

    That is by default what evidence could come from.
    """
    here, there = _predicted(fit), _predicted(fit, timestep / FINE, "RK4")
    if (size or _change)(fit, here, there) < NEGLIGIBLE:
        return None
    for ratio in RATIOS:
        coarser = there if ratio == FINE else _predicted(fit, timestep / ratio, "RK4")
        if ratio == FINE or (np.isfinite(coarser).all() and _moved(fit, coarser, there) < NEGLIGIBLE):
            return timestep / ratio, "RK4", coarser - here
    return None


def _at(fit: Fit, timestep: float | None, integrator: str | None) -> Problem:
    return replace(fit.problem, timestep=timestep, integrator=integrator, finer=None)


def _predicted(fit: Fit, timestep: float | None = None, integrator: str | None = None) -> np.ndarray:
    problem = fit.problem if timestep is None else _at(fit, timestep, integrator)
    return problem.simulator.rollout(problem.request(fit.point.z[None], fit.point.start))


def _change(fit: Fit, here: np.ndarray, there: np.ndarray) -> float:
    """Whitened squared change of the prediction that neither psi nor the starts can absorb; 0 where one diverges."""
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        return 0.0
    return _unabsorbed(fit, _difference(fit, here, there))


def _moved(fit: Fit, here: np.ndarray, there: np.ndarray) -> float:
    """The same that unknowns may absorb, who are then as many sds off as its root at most."""
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        return 0.0
    return float((_difference(fit, here, there) ** 2).sum())


def _promise(fit: Fit, shift: Float[np.ndarray, "segments samples columns"]) -> float:
    """What a shift of the prediction gains in log likelihood to first order, nats."""
    here, n = _predicted(fit), fit.linear.degrees_of_freedom
    chi2 = max(_chi2_with(fit, here, here + shift), 0.0)
    told = [-profile(x, max(1.0, x / fit.problem.measurement.mean_square / n), n) for x in (fit.chi2, chi2)]
    return told[1] - told[0]


def _chi2_with(fit: Fit, here: np.ndarray, there: np.ndarray) -> float:
    """What another prediction leaves to first order; infinite where one diverges."""
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        return np.inf
    r = fit.linear.latent.project(fit.linear.stacked)[..., 0]
    return fit.chi2 + _unabsorbed(fit, r - _difference(fit, here, there)) - _unabsorbed(fit, r)


def _difference(fit: Fit, here: np.ndarray, there: np.ndarray) -> Float[np.ndarray, "segments stacked"]:
    """What no initial state takes up of the whitened residuals' difference between two predictions."""
    difference = fit.problem.residuals(here) - fit.problem.residuals(there)
    return fit.linear.latent.project(fit.linear.latent.stack(difference[..., None]))[..., 0]


def _unabsorbed(fit: Fit, x: Float[np.ndarray, "segments stacked"]) -> float:
    """The squared length of what unknowns do not take up, to first order, of a whitened change."""
    j = fit.linear.latent.project(fit.linear.columns)
    slope = np.einsum("snk,sn->k", j, x)
    gram = np.einsum("snk,snl->kl", j, j) + np.eye(fit.problem.size)
    return float((x**2).sum() - (slope @ np.linalg.solve(gram, slope) if fit.problem.size else 0.0))
