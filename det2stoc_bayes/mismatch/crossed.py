"""Hypotheses refitted without some recordings, and how they tell those."""

from collections.abc import Collection, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR
from det2stoc_bayes.mismatch.heldout import foretold
from det2stoc_bayes.mismatch.race import tolerance
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.segments import from_pieces

TOLERANCE = 0.3  # nats
FOLDS = 2
NUM_BOOTSTRAPS = 4000


def refitted_without(
    fit: Fit, names: Collection[str], *, tolerance: float = TOLERANCE, max_iterations: int = 8
) -> Float[np.ndarray, " size"]:
    """The unknowns fitted to all recordings but these, in the layout of the fit's own."""
    segments = fit.problem.segments
    others = [r for r in segments.recordings if r.name not in names]
    rows = [s for s, r in enumerate(segments.recording) if segments.recordings[r].name not in names]
    begin, length = segments.first[rows], segments.lengths[rows]
    owner = [others.index(segments.recordings[segments.recording[s]]) for s in rows]
    pieces = [(r, int(a), int(a + n)) for r, a, n in zip(owner, begin, length, strict=True)]
    problem = fit.problem.on(from_pieces(others, pieces, segments.columns))
    start = Start(*(getattr(fit.point.start, a)[rows] for a in ("qpos", "qvel", "act")))
    point = Point(fit.problem.carry(fit.point.z, problem), start)
    found = fit_many([(problem, point)], tolerance=tolerance, max_iterations=max_iterations)[0]
    return fit.point.z if found is None else found.problem.carry(found.point.z, fit.problem)


@lru_cache(maxsize=16)
def unseen(fit: Fit) -> dict[str, float]:
    """Whitened squared error of rollouts of recordings that were not fitted: held-out ones, or halves left out in turn.

    Initial states come from the samples before: fitted to all samples they would take up what the model lacks.
    """
    holdout = fit.problem.simulator.study.holdout
    return foretold(fit, fit.point.z, holdout) if holdout else crossed(fit)


def others_exist(fit: Fit) -> bool:
    """Whether there are recordings that were not fitted, or enough to leave some out."""
    return bool(fit.problem.simulator.study.holdout) or len(fit.problem.segments.recordings) >= FOLDS


def misses(fit: Fit) -> bool:
    """Whether a misfit beyond the noise stays, so that recordings that were not fitted judge."""
    return fit.noise_inflation >= MODEL_ERROR and others_exist(fit)


def crossed(fit: Fit) -> dict[str, float]:
    """Whitened squared error of rollouts of every recording under unknowns fitted to other ones, in FOLDS folds."""
    recordings = fit.problem.segments.recordings
    errors: dict[str, float] = {}
    for k in range(FOLDS):
        left = recordings[k::FOLDS]
        z = refitted_without(fit, {r.name for r in left}, tolerance=tolerance(fit), max_iterations=3)
        errors |= foretold(fit, z, left)
    return errors


def untold(fit: Fit) -> float:
    """What a fit leaves of recordings that were not fitted, in all."""
    return sum(unseen(fit).values())


def chances(fits: Sequence[Fit]) -> Float[np.ndarray, " fits"]:
    """Probability of each fit to tell recordings like these best: the Bayesian bootstrap over them (Rubin, 1981)."""
    errors = [unseen(f) for f in fits]
    names = list(errors[0])
    table = np.array([[e[name] for name in names] for e in errors])
    weights = np.random.default_rng(0).dirichlet(np.ones(len(names)), NUM_BOOTSTRAPS)
    best = np.argmin(weights @ table.T, axis=1)
    return np.bincount(best, minlength=len(fits)) / NUM_BOOTSTRAPS
