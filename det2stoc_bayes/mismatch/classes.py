"""Explanations that no recording of the study can tell apart, as one class with one probability."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.crossed import chances, others_exist
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, probabilities, whitened
from det2stoc_bayes.mismatch.race import Ranked, Slot
from det2stoc_bayes.optimize import Fit

AGREEMENT = 0.3  # noise sds (rms) within which predictions agree
SIGMAS = 2.0  # by which the recordings could tell two predictions apart at most: below it nothing is told
WEAK = 0.01  # of the precision of effects' priors
FREE = 0.98  # of the prior's variance: a direction of which this much is left is not determined
LIKELIHOOD = 1.0  # nats within which the best fits agree,
PARAMETER = 3.0  # and for each parameter more: by chance two gain over 7 nats in one of a thousand (Wilks' theorem)


@dataclass(frozen=True, eq=False)
class Class:
    """Members that predict alike, simplest first, and their probability together."""

    members: tuple[Ranked, ...]
    alike: tuple[Ranked, ...]  # the members and larger families that gain nothing
    probability: float


def classes(slot: Slot, num_candidates: int, share: float) -> list[Class]:
    """Refined candidates of one slot in equivalence classes, most probable first.

    Members fit equally well and predict alike. Their prior scales are conventions, so it is the likelihood that is
    compared, where the priors of effects are too wide to matter, not the evidence, which those scales enter. A family
    with more parameters that gains nothing by them counts for the class, but only the smallest are its members, those
    parameters counted that the recordings determine: on one slide a tilt is one number. Curves over other variables
    are no such families, and are all members.
    """
    left = list(slot.ranked)
    chance = dict(zip((id(r) for r in left), _chances(slot, num_candidates), strict=True))
    found = []
    while left:
        best = left[0]
        alike = [r for r in left if r is best or _alike(best, r, share)]
        left = [r for r in left if not any(r is m for m in alike)]
        listed = [r for r in alike if r.placed.effect.listed]
        sizes = {id(r): determined(r) for r in alike}
        smallest = min(sizes[id(r)] for r in listed or alike)
        fewest = min(r.placed.effect.complexity for r in alike)
        members = sorted(
            (r for r in alike if (sizes[id(r)] == smallest if listed else r.placed.effect.complexity == fewest)),
            key=lambda r: (r.placed.size, r.placed.effect.complexity),
        )
        found.append(Class(tuple(members), tuple(alike), float(sum(chance[id(r)] for r in alike))))
    return sorted(found, key=lambda c: -c.probability)


def _chances(slot: Slot, num_candidates: int) -> Float[np.ndarray, " ranked"]:
    """By evidence; under model error, which makes any difference certain, by how other recordings are told.

    Those asked for the effect, too, and know none that does without.
    """
    fits = [r.fit for r in slot.ranked]
    if fits and min(f.noise_inflation for f in fits) >= MODEL_ERROR and others_exist(slot.base):
        return chances(fits)
    return probabilities([r.gain for r in slot.ranked], num_candidates)


def _alike(a: Ranked, b: Ranked, share: float) -> bool:
    """Whether the likelihoods differ by less than chance and the predictions by less than the noise."""
    s2 = max(min(a.fit.noise_scale, b.fit.noise_scale), 1.0)
    (left_a, chi2_a), (left_b, chi2_b) = _unbound(a.fit), _unbound(b.fit)
    apart = (left_a - left_b) ** 2 / s2
    if share * np.nansum(apart) < SIGMAS**2:
        return True
    more = abs(a.placed.size - b.placed.size)
    if 0.5 * share * abs(chi2_a - chi2_b) / s2 > LIKELIHOOD + PARAMETER * more:
        return False
    return float(np.sqrt(np.nanmean(apart))) < AGREEMENT


def determined(ranked: Ranked) -> int:
    """Of how many directions of the addition's parameters the recordings say anything, the others being free."""
    problem = ranked.fit.problem
    before = problem.effects[: problem.effects.index(ranked.placed)]
    begin = problem.num_psi + sum(e.size for e in before)
    own = slice(begin, begin + ranked.placed.size)
    covariance = np.linalg.inv(_gram(ranked.fit, _columns(ranked.fit)) + np.eye(problem.size))[own, own]
    return int((np.linalg.eigvalsh(covariance) < FREE).sum())


def _unbound(fit: Fit) -> tuple[Float[np.ndarray, "segments samples columns"], float]:
    """Whitened residuals and chi2, to first order, where the effects' priors are ten times as wide."""
    left, first, columns = whitened(fit), fit.problem.num_psi, _columns(fit)
    precision = np.eye(fit.problem.size)
    precision[first:, first:] *= WEAK
    pull = np.where(np.arange(fit.problem.size) < first, 0.0, (1 - WEAK) * fit.point.z)
    moved = left - (columns @ np.linalg.solve(_gram(fit, columns) + precision, pull)).reshape(left.shape)
    return moved, float(fit.chi2 + np.nansum(moved**2) - np.nansum(left**2))


def _columns(fit: Fit) -> Float[np.ndarray, "segments values size"]:
    """Sensitivities of the whitened residuals; 0 where nothing was recorded."""
    columns = fit.linear.latent.project(fit.linear.columns)[:, : fit.problem.weight.shape[1]]
    return np.where(np.isfinite(whitened(fit)).reshape(*columns.shape[:2], 1), columns, 0.0)


def _gram(fit: Fit, columns: Float[np.ndarray, "segments values size"]) -> Float[np.ndarray, "size size"]:
    """What the recordings say of the unknowns, in units of the prior's precision."""
    return np.einsum("snk,snl->kl", columns, columns) / max(fit.noise_scale, 1.0)
