"""One addition after the other: the soonest end of a search, where the second leaves but chance."""

from collections.abc import Sequence

from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import by_chance
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.race import Slot, gain
from det2stoc_bayes.optimize import Fit

NEARLY_LINEAR = 100.0  # noise inflation up to which screening foretells which pairs explain most


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
    # What explains most alone may be what two others look like together: those that promise more are fitted.
    rivals = looks.truer_pairs(base, slot.screened, both[0], needed) if base.noise_inflation < NEARLY_LINEAR else []
    truer = [f for f in rivals if by_chance(f) and gain(both[0], f, 1.0) > needed]
    return truer[0] if truer else best.fit, []
