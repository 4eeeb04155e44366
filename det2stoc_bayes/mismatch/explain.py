"""From a misfit to the effects that remove it: screen, refine, add the best, again, then look back at each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from det2stoc_bayes.mismatch.crossed import misses, others_exist, untold
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, by_chance, effective_share, log_told
from det2stoc_bayes.mismatch.horizon import reaches
from det2stoc_bayes.mismatch.kin import truer_pair
from det2stoc_bayes.mismatch.leading import leading
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.race import Ranked, Slot, gain, threshold
from det2stoc_bayes.mismatch.refine import NUM_PAIRS, PROMISING
from det2stoc_bayes.mismatch.refit import refit, reordered, swap, without, without_each
from det2stoc_bayes.mismatch.rivals import with_rivals
from det2stoc_bayes.mismatch.shares import NEGLIGIBLE
from det2stoc_bayes.optimize import Fit

MAX_EFFECTS = 3
NUM_CROSSED = 3  # single additions, and successive ones, beside pairs, that other recordings decide between
NUM_WIDE = 24  # pairs where the few best leave a misfit beyond the noise as it is
CLEARLY = 1.0  # nats by which a rival must be ahead to take an effect's place
INDISPENSABLE = 100.0  # nats of an effect without which nothing can be simulated
MAX_ROUNDS = 3  # explanations, each without what the last had in vain


@dataclass(frozen=True, eq=False)
class Explanation:
    """The believed model's fit, the fit with all effects, and a slot for each of them."""

    before: Fit
    after: Fit
    slots: tuple[Slot, ...]
    num_candidates: int
    share: float  # independent samples per sample
    others_chose: bool = False  # recordings that were not fitted decided between additions


def explain(before: Fit, pool: Sequence[PlacedEffect], looks: Looks) -> Explanation:
    """Effects are added while the best still earns its evidence, then each is judged with the others in place.

    Where the misfit stays beyond the noise, effects that do not help held-out recordings make room for others.
    """
    count = len(pool)
    first = looks.at(before, pool)
    grown, lean = grow(first, pool, threshold(count), looks)
    for _ in range(MAX_ROUNDS - 1):
        kept, lean, useless = _without_useless(before, grown, lean)
        if not useless:
            break
        looks.others_chose = True
        pool = [c for c in pool if c not in useless]
        first = looks.at(before, pool)
        grown, again = grow(first, pool, threshold(count), looks)
        if others_exist(kept) and reaches(kept, grown) and untold(kept) <= untold(grown):
            grown = kept
            break
        lean = again
    if len(grown.problem.effects) == 0:
        return Explanation(before, before, (first,), count, 1.0)
    if len(grown.problem.effects) == 1 and not by_chance(grown):
        own = Ranked(grown.problem.effects[0], grown, 0.0)
        grown = truer_pair(first, own, threshold(count)) or grown
    bare = bare_fit(before, grown)
    if len(grown.problem.effects) == 1 and bare is before:
        own = next((r for r in first.ranked if r.placed == grown.problem.effects[0]), None)
        if own is not None:  # a later effect, left alone once the first was dropped, may not be there
            slot = with_rivals(first, own)
            after = slot.ranked[0].fit if _ahead(slot.ranked[0], _present(slot, own.placed)) else grown
            return Explanation(
                before, after, (slot,), count, effective_share(after), looks.others_chose or misses(after)
            )
    if len(grown.problem.effects) == 1:
        own = grown.problem.effects[0]
        pool, lean = _promising(first, own) or pool, {own: bare}
    grown, slots = judged(grown, lean, pool, looks)
    return Explanation(bare, grown, slots, count, effective_share(grown), looks.others_chose or misses(grown))


def _promising(slot: Slot, own: PlacedEffect) -> list[PlacedEffect]:
    """Candidates that need a second look at a longer horizon; empty where the effect itself did not promise much."""
    least = PROMISING * max((s.log_evidence for s in slot.screened), default=0.0)
    found = [s.placed for s in slot.screened if s.log_evidence > least]
    return found if own in found else []


def judged(
    grown: Fit, lean: dict[PlacedEffect, Fit], pool: Sequence[PlacedEffect], looks: Looks
) -> tuple[Fit, tuple[Slot, ...]]:
    """Every place of the list with what could stand there; what clearly has more evidence takes the place."""
    slots: dict[int, Slot] = {}
    swaps = 0
    while stale := [i for i in range(len(grown.problem.effects)) if i not in slots]:
        i = stale[0]
        own = grown.problem.effects[i]
        slots[i] = _judge(grown, i, lean.get(own), pool, looks)
        best = slots[i].ranked[0]
        if _ahead(best, _present(slots[i], own)) and best.placed not in grown.problem.effects and swaps < MAX_EFFECTS:
            grown, lean, slots, swaps = swap(grown, i, best), {}, {i: slots[i]}, swaps + 1
    return grown, tuple(slots[i] for i in range(len(slots)))


def _present(slot: Slot, placed: PlacedEffect) -> Ranked:
    """The effect that stands in a place, among its rivals."""
    return next(r for r in slot.ranked if r.placed == placed)


def _ahead(rival: Ranked, present: Ranked) -> bool:
    """Whether a rival takes an effect's place."""
    return bool(rival.gain > present.gain + CLEARLY)


def bare_fit(before: Fit, grown: Fit) -> Fit:
    """The believed model on the segments of the explanation; as it was where it cannot follow them."""
    if grown.problem.segments.extent == before.problem.segments.extent:
        return before
    return refit(grown, ()) or before


def grow(
    first: Slot, pool: Sequence[PlacedEffect], needed: float, looks: Looks, most: int = MAX_EFFECTS
) -> tuple[Fit, dict[PlacedEffect, Fit]]:
    """The best effects one after the other, or two at once, up to so many; and fits without each of those that stay."""
    slot = first
    if len(slot.base.problem.effects) >= most:
        return _prune(slot.base, needed)
    while True:
        better = _better(slot, pool, needed, first.base, looks, most)
        if better is None:
            return _prune(slot.base, needed)
        better = looks.extended(better)
        if len(better.problem.effects) >= most or enough(better, first.base):
            return _prune(better, needed)
        slot = looks.at(better, pool)


def _better(
    slot: Slot, pool: Sequence[PlacedEffect], needed: float, believed: Fit, looks: Looks, most: int = MAX_EFFECTS
) -> Fit | None:
    """The next step; None where nothing earns its place. More pairs are tried before a misfit is called unexplained."""
    base = slot.base
    room = len(base.problem.effects) + 2 <= most
    lead, successive = leading(slot, pool, needed, looks) if room else (None, [])
    if lead is not None:
        return lead
    found = _best_of(slot, needed, believed, looks, NUM_PAIRS if room else 0, successive)
    if found is None and room and not base.problem.effects and base.noise_inflation >= MODEL_ERROR:
        return _best_of(slot, needed, believed, looks, NUM_WIDE, successive)
    return found


def _best_of(
    slot: Slot, needed: float, believed: Fit, looks: Looks, num_pairs: int, successive: Sequence[Fit]
) -> Fit | None:
    """The addition, or the two, with most evidence; None where nothing earns its place.

    While pairs and single ones leave a misfit beyond the noise, evidence favours what bends to the fitted recordings.
    Then the one is taken that tells others best, two of which one was found beside the other (`successive`) among
    them; each addition must explain a share of the believed model's misfit there.
    """
    base, single = slot.base, {r.placed: r.fit for r in slot.ranked}
    alone = [r.fit for r in slot.ranked if r.gain >= needed]
    least = needed + max([0.0, *(s.log_evidence for s in slot.screened[:1])])
    wanted = num_pairs > 0 and not (alone and enough(alone[0], believed))
    both = looks.pairs(base, slot.screened, least, num_pairs) if wanted else []
    contenders = [*both, *alone[:NUM_CROSSED]]
    if not contenders:
        return None
    if not others_exist(base) or min(f.noise_inflation for f in contenders) < MODEL_ERROR:
        for f in both:
            if _earns(f, [single[e] for e in f.problem.effects[-2:] if e in single] + alone[:1], base, needed):
                return f
        return next(iter(alone), None)
    looks.others_chose = True
    contenders += successive[:NUM_CROSSED]
    price = NEGLIGIBLE * untold(believed)
    first = len(base.problem.effects)
    scores = [untold(f) + price * (len(f.problem.effects) - first) for f in (base, *contenders)]
    best = int(np.argmin(scores))
    return contenders[best - 1] if best else None


def enough(fit: Fit, believed: Fit) -> bool:
    """Whether what is left is chance, or within the noise and negligible beside the believed model's misfit.

    Over parts of recordings nothing is negligible: their starts absorb most of what is missing.
    """
    left, segments = fit.noise_inflation - 1, fit.problem.segments
    small = fit.noise_inflation < MODEL_ERROR and left < NEGLIGIBLE * (believed.noise_inflation - 1)
    return (small and segments.whole) or by_chance(fit)


def _without_useless(
    before: Fit, grown: Fit, lean: dict[PlacedEffect, Fit]
) -> tuple[Fit, dict[PlacedEffect, Fit], set[PlacedEffect]]:
    """Drops, one after the other, effects without which other recordings are told as well; and says which.

    None where the misfit is within the noise.
    """
    useless: set[PlacedEffect] = set()
    if not grown.problem.effects or not misses(grown):
        return grown, lean, useless
    bare = bare_fit(before, grown)
    follows = bare.problem.segments.extent == grown.problem.segments.extent
    believed = untold(bare)
    while effects := grown.problem.effects:
        one, whole = len(effects) == 1, untold(grown)
        rest: dict[PlacedEffect, Fit | None] = dict.fromkeys(effects, bare if follows else None)
        if not one:
            rest = lean | _leaner(grown, [e for e in effects if e not in lean])
        told = {e: 1.0 if f is None else (untold(f) - whole) / believed for e, f in rest.items()}
        worst = min(effects, key=lambda e: told[e])
        if told[worst] >= NEGLIGIBLE:
            return grown, {e: f for e, f in rest.items() if f is not None}, useless
        grown, lean = rest[worst] or grown, {}
        useless.add(worst)
    return grown, lean, useless


def _leaner(fit: Fit, dropped: Sequence[PlacedEffect]) -> dict[PlacedEffect, Fit | None]:
    """The best fit without each of these effects, None where there is none."""
    return dict(zip(dropped, without_each(fit, dropped), strict=True))


def _earns(both: Fit, alone: Sequence[Fit], base: Fit, needed: float) -> bool:
    """Whether two additions are needed where these are the best single ones.

    Wide posteriors of unknowns that trade with each other are no reason: the recordings must be told better.
    """
    share = effective_share(both)
    told = [share * (log_told(both) - log_told(f)) for f in alone]
    gains = [gain(f, both, share) for f in alone or [base]]
    return bool(min(gains + told) > (needed if alone else 2 * needed))


def _judge(final: Fit, i: int, base: Fit | None, pool: Sequence[PlacedEffect], looks: Looks) -> Slot:
    """What could stand in place i of the list, the other effects staying; the present one competes too.

    Alone where no simulation follows the recordings without it: its slot's base is then the fit that has it.
    """
    own = Ranked(final.problem.effects[i], reordered(final, i), INDISPENSABLE)
    base = base or without(final, i)
    if base is None:
        return Slot(final, (), (own,))
    slot = looks.at(base, pool, own.fit)
    return with_rivals(slot, replace(own, gain=gain(slot.base, own.fit, effective_share(final))))


def _prune(fit: Fit, needed: float) -> tuple[Fit, dict[PlacedEffect, Fit]]:
    """Drops effects that no longer earn their place beside the later ones; fits without each of those that stay.

    Where other recordings chose them, those judge them, too.
    """
    lean: dict[PlacedEffect, Fit] = {}
    effects = fit.problem.effects
    if len(effects) < 2 or misses(fit):
        return fit, lean
    for placed in effects:
        rest = without(fit, fit.problem.effects.index(placed))
        if rest is not None and gain(rest, fit, effective_share(fit)) < needed:
            fit, lean = rest, {}
        elif rest is not None:
            lean[placed] = rest
    return fit, lean
