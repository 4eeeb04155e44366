"""One addition after the other: the soonest end of a search, where the second leaves but chance."""

from collections.abc import Sequence

from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import by_chance
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.race import MOST_ITERATIONS, Slot, allowed, gain, tolerance
from det2stoc_bayes.optimize import Fit, fit_many

NEARLY_LINEAR = 100.0  # noise inflation up to which screening foretells which pairs explain most
PROMISED = 0.8  # of what the best promised: who promised so much and was on its way is followed to its end
MOST_SLOW = 2  # of these


def leading(slot: Slot, pool: Sequence[PlacedEffect], needed: float, looks: Looks) -> tuple[Fit | None, list[Fit]]:
    """The best addition, where a second one beside it leaves but chance: one after the other is found soonest.

    Where it does not, None and the fits with both, best first, on the segments of the slot.
    """
    best, base = slot.ranked[0] if slot.ranked else None, slot.base
    if best is None or best.gain < needed or by_chance(best.fit):
        return None, []
    second = [r.fit for r in looks.at(looks.extended(best.fit), pool).ranked if r.gain >= needed]
    both = [f for f in second if by_chance(f) and f.problem.segments.whole]
    if not both:
        return None, [f for f in second if f.problem.segments.key == base.problem.segments.key]
    single = _single(slot)
    if single is not None and by_chance(looks.extended(single)):
        return single, []
    # What explains most alone may be what two others look like together: those that promise more are fitted.
    rivals = looks.truer_pairs(base, slot.screened, both[0], needed) if base.noise_inflation < NEARLY_LINEAR else []
    truer = [f for f in rivals if by_chance(f) and gain(both[0], f, 1.0) > needed]
    return truer[0] if truer else best.fit, []


def _single(slot: Slot) -> Fit | None:
    """A lone addition that leaves but chance after all, though a race ended before it was there.

    A payload beside its body's uncertain mass has a long way, on which a shift of its centre and less gravity lead.
    """
    promised = {s.placed: s.log_evidence for s in slot.screened}
    least = PROMISED * max(promised.values(), default=0.0)
    slow = [r.fit for r in slot.ranked[1:] if r.fit.end == "unfinished" and promised.get(r.placed, 0.0) >= least]
    points = [(f.problem, f.point) for f in slow[:MOST_SLOW]]
    found = fit_many(points, max_iterations=MOST_ITERATIONS, tolerance=tolerance(slot.base)) if points else []
    first = len(slot.base.problem.effects)
    there = [f for f in found if f is not None and by_chance(f) and allowed(f, first)]
    return min(there, key=lambda f: f.chi2, default=None)
