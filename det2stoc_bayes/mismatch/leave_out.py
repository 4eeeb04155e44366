"""Predictive densities of recordings that were left out, checked by importance weights, and how they stack up."""

from dataclasses import replace

from det2stoc_bayes.mismatch.belief import Belief
from det2stoc_bayes.mismatch.crossed import refitted_without
from det2stoc_bayes.mismatch.heldout import HeldOut, evaluate
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.psis import reliable, smooth


def k_hats(belief: Belief) -> dict[str, float]:
    """k-hat of weights 1 / p(recording | z) on a posterior's draws: how far its removal moves the posterior.

    Empty where the draws were not weighed.
    """
    if belief.terms is None:
        return {}
    names = [r.name for r in belief.fit.problem.segments.recordings]
    return {name: smooth(-terms)[1] for name, terms in zip(names, belief.terms.T, strict=True)}


def doubtful(belief: Belief, k: dict[str, float]) -> tuple[str, ...]:
    """Recordings whose removal weights cannot tell, by their k-hats; all of them where draws could not be weighed."""
    if belief.terms is None and belief.k_hat is not None:
        return tuple(r.name for r in belief.fit.problem.segments.recordings)
    return tuple(name for name, value in k.items() if value > reliable(len(belief.z)))


def checked(fit: Fit, held: HeldOut, belief: Belief) -> tuple[HeldOut, dict[str, float], tuple[str, ...]]:
    """Scores with exact refits where down-dating cannot be trusted; k-hat by recording; the recordings refitted.

    Held-out recordings of their own, or a single one, leave nothing to check.
    """
    study = fit.problem.simulator.study
    if study.holdout or len(study.recordings) == 1:
        return held, {}, ()
    k = k_hats(belief)
    names = doubtful(belief, k)
    if not names:
        return held, k, ()
    again = {name: refitted_without(fit, {name}) for name in names}
    records = tuple(r for r in study.recordings if r.name in again)
    return _merged(held, evaluate(fit, again, records, held.samples)), k, names


def _merged(old: HeldOut, new: HeldOut) -> HeldOut:
    """Scores of which some recordings' are replaced."""
    at = [old.names.index(n) for n in new.names]
    changed = {}
    for name in ("log_density", "chi2", "num_values", "squared_error", "num_errors"):
        values = getattr(old, name).copy()
        values[at] = getattr(new, name)
        changed[name] = values
    return replace(old, **changed, rollouts=old.rollouts | new.rollouts)
