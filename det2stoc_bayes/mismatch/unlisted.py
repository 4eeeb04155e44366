"""What listed effects leave: a force of any shape on a joint, taken where it clearly tells the recordings better.

It comes last. Where listed effects explain all but chance there is no need of it; a listed effect that predicts as a
curve does, fitted from where the curve's fit ended, takes the curve's place.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from det2stoc_bayes.mismatch.crossed import misses, others_exist, untold
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.effects.unlisted import FORMS
from det2stoc_bayes.mismatch.evidence import by_chance, effective_share, log_evidence
from det2stoc_bayes.mismatch.explain import Explanation, bare_fit, enough, explain, grow, judged
from det2stoc_bayes.mismatch.horizon import FAR, extend, reaches
from det2stoc_bayes.mismatch.kin import truer_pair
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.race import Ranked, added, gain, race, threshold, tolerance
from det2stoc_bayes.mismatch.refine import NUM_PAIRS
from det2stoc_bayes.mismatch.screen import Screened
from det2stoc_bayes.mismatch.shares import NEGLIGIBLE
from det2stoc_bayes.mismatch.unlisted_screen import joints, reshaped, screen_unlisted
from det2stoc_bayes.optimize import Fit, fit_many

NUM_REFINED = 2
MOST_BESIDE = 1  # listed effects beside a curve: with two more whatever is recorded is bent to
MOST_RESHAPED = 3  # times that a curve's prior is chosen anew
ENOUGH = 2.0  # nats: a choice that gains less is the last one
LEFT = 0.2  # of the misfit: what leaves more is not the shape that is missing
MOST_SPENT = 8.0  # first looks, in steps; after more of them listed effects are not looked for beside a curve
PROMISING = 0.5  # of the evidence that listed effects earn: what a curve must promise to be fitted


@dataclass(frozen=True, eq=False)
class _Curves:
    """Curves beside a fit: those that were fitted, best first, and what screening said of them."""

    screened: list[Screened]
    ranked: list[Ranked]


def explain_by_all(before: Fit, pool: Sequence[PlacedEffect], looks: Looks) -> Explanation:
    """The explanation by listed effects, or with a curve where they leave a misfit that it takes away.

    Of a lone recording a curve takes up whatever happens on its joint, and no other recording would tell.
    """
    if not joints(pool) or not others_exist(before):
        return explain(before, pool, looks)
    return _at_once(before, pool, looks) or beyond_list(before, explain(before, pool, looks), pool, looks)


def _at_once(before: Fit, pool: Sequence[PlacedEffect], looks: Looks) -> Explanation | None:
    """A curve that explains all but chance, where it is far ahead of every listed effect and of pairs of them.

    Without it pairs beyond number would be tried in vain.
    """
    if by_chance(before):
        return None
    needed, first = threshold(_count(pool)), looks.at(before, pool)
    single = [r.fit for r in first.ranked]
    if any(enough(f, before) for f in single):
        return None
    listed = max([0.0, *(s.log_evidence for s in first.screened[:1]), *(gain(before, f, 1.0) for f in single)])
    # A surface over position and velocity is many listed effects at once: it waits until these were searched.
    curves = _beside(before, pool, 1, listed + needed, looks)
    best = extend(curves.ranked[0].fit) if curves.ranked else None
    if best is None or not enough(best, before):
        return None
    promised = max(PROMISING * s.log_evidence for s in curves.screened)
    pairs = looks.pairs(before, first.screened, max(needed + listed, promised), NUM_PAIRS)
    if any(enough(f, before) or gain(f, curves.ranked[0].fit, 1.0) < needed for f in pairs):
        return None
    base = before if best is curves.ranked[0].fit else bare_fit(before, best)
    return _with(best, Explanation(base, base, (first,), len(pool), 1.0), curves, pool, looks)


def beyond_list(before: Fit, found: Explanation, pool: Sequence[PlacedEffect], looks: Looks) -> Explanation:
    """The explanation, with a curve where listed effects leave a misfit that it takes away.

    What is far from the recordings over stretches as short as the search's, from `before` on, is not fitted to longer.
    """
    if not _wanted(found):
        return found
    needed = threshold(_count(pool))
    for num_variables in (1, 2):
        least = max(PROMISING * _earned(found), needed)
        if found.before is not before and found.after.noise_inflation >= FAR:
            short = _beside(before, pool, num_variables, least, looks)
            if all(r.fit.noise_inflation >= FAR for r in short.ranked):
                continue
        curves = _beside(found.before, pool, num_variables, least, looks)
        for ranked in curves.ranked[:1]:
            if _hopeless(ranked.fit, found.after):
                continue
            better = _completed(ranked.fit, found, needed, looks)
            if _clearly(better, found, needed):
                return _with(better, found, curves, pool, looks)
    return found


def _count(pool: Sequence[PlacedEffect]) -> int:
    """Listed candidates and curves."""
    return len(pool) + len(FORMS) * len(joints(pool))


def _wanted(found: Explanation) -> bool:
    """Whether more than chance is left, or several effects were needed, whose place one curve may take."""
    return len(found.after.problem.effects) > 1 or not enough(found.after, found.before)


def _earned(found: Explanation) -> float:
    """Evidence of the listed effects."""
    return gain(found.before, found.after, found.share) if found.after is not found.before else 0.0


def _beside(base: Fit, pool: Sequence[PlacedEffect], num_variables: int, least: float, looks: Looks) -> _Curves:
    """Curves beside a fit, those fitted that promise more than `least` nats, most evidence first."""
    screened = looks.once(
        base, ("screened", num_variables, tuple(joints(pool))), lambda: screen_unlisted(base, pool, num_variables)
    )
    least = max(least, *(PROMISING * s.log_evidence for s in screened[:1]), 0.0)
    worth = [s for s in screened if s.log_evidence > least][:NUM_REFINED]
    return looks.once(base, ("fitted", *(s.placed for s in worth)), lambda: _fitted(base, worth))


def _fitted(base: Fit, worth: Sequence[Screened]) -> _Curves:
    """These curves beside a fit, the best of them with the prior that suits it."""
    fits = race(base, [added(base, s.change, [(s, s.coefficients)]) for s in worth])
    if not fits:
        return _Curves([], [])
    share = effective_share(min(fits, key=lambda f: f.chi2))
    first, *rest = sorted(fits, key=lambda f: -gain(base, f, share))
    own = next(s for s in worth if s.placed == first.problem.effects[-1])
    if first.noise_inflation - 1 < LEFT * (base.noise_inflation - 1):  # else no shape of it is what is missing
        first, own = _settled(first, own)
    share = effective_share(first)
    ranked = [Ranked(f.problem.effects[-1], f, gain(base, f, share)) for f in (first, *rest)]
    told = [own, *(s for s in worth if s.placed in [r.placed for r in ranked[1:]])]
    return _Curves(told, sorted(ranked, key=lambda r: -r.gain))


def _settled(fit: Fit, screened: Screened) -> tuple[Fit, Screened]:
    """The curve with the smoothness, size and range that suit its own fit, where that gains."""
    for _ in range(MOST_RESHAPED):
        found = reshaped(fit)
        if found is None:
            break
        bare, s = found
        better = fit_many([added(bare, s.change, [(s, s.coefficients)])], tolerance=tolerance(fit))[0]
        if better is None:
            break
        share = effective_share(better)
        step = log_evidence(better, share) - log_evidence(fit, share)
        if step > 0:
            fit, screened = better, s
        if step < ENOUGH:
            break
    return fit, screened


def _completed(fit: Fit, found: Explanation, needed: float, looks: Looks) -> Fit:
    """The curve at the longest horizon; where more than chance is left, beside listed effects that were near before.

    Beside a curve of dozens of unknowns a look takes long: after a long search it is not taken any more.
    """
    fit = extend(fit)
    if enough(fit, found.before) or len(found.after.problem.effects) == 0 or looks.spent(fit) > MOST_SPENT:
        return fit
    near = list(dict.fromkeys(r.placed for slot in found.slots for r in slot.ranked))
    return grow(looks.at(fit, near), near, needed, looks, len(fit.problem.effects) + MOST_BESIDE)[0]


def _hopeless(curve: Fit, listed: Fit) -> bool:
    """Whether both are far from the recordings, and the curve predicts less far or those that were not fitted worse.

    To look what is missing beside it takes as long as the whole search before, for a name that nobody should believe.
    """
    if min(curve.noise_inflation, listed.noise_inflation) < FAR:
        return False
    return not reaches(curve, listed) or untold(curve) > untold(listed)


def _clearly(fit: Fit, found: Explanation, needed: float) -> bool:
    """Whether a fit with a curve tells more than the listed effects, on recordings that were not fitted as well."""
    listed = found.after
    if fit.problem.segments.extent != listed.problem.segments.extent:
        return fit.problem.segments.whole and enough(fit, found.before)
    share = effective_share(min((fit, listed), key=lambda f: f.chi2))
    if gain(listed, fit, share) < needed:
        return False
    if enough(listed, found.before):
        return enough(fit, found.before)
    if not enough(fit, found.before) and fit.noise_inflation - 1 > LEFT * (listed.noise_inflation - 1):
        return False
    return untold(fit) + NEGLIGIBLE * untold(found.before) < untold(listed)


def _with(fit: Fit, found: Explanation, curves: _Curves, pool: Sequence[PlacedEffect], looks: Looks) -> Explanation:
    """The explanation by a fit that has a curve: every place with what could stand there, other curves among it."""
    found = replace(found, before=bare_fit(found.before, fit))
    first, extent = looks.at(found.before, pool), found.before.problem.segments.extent
    # What was found on shorter parts of recordings has other evidence, and responses of another shape.
    here = [r for r in curves.ranked if r.fit.problem.segments.extent == extent]
    known = {r.placed for r in here}
    told = [s if s.placed in known else replace(s, response=None) for s in curves.screened]
    screened = sorted([*first.screened, *told], key=lambda s: -s.log_evidence)
    ranked = sorted([*first.ranked, *here], key=lambda r: -r.gain)
    slot = replace(first, screened=tuple(screened), ranked=tuple(ranked))
    whole, lean = [*pool, *(s.placed for s in curves.screened)], {}
    looks.know(slot, whole)
    if len(fit.problem.effects) == 1:
        own = Ranked(fit.problem.effects[0], fit, gain(found.before, fit, effective_share(fit)))
        pair = truer_pair(slot, own, 0.0)
        fit, lean = (fit, {own.placed: found.before}) if pair is None else (pair, {})
    after, slots = judged(fit, lean, whole, looks)
    others = looks.others_chose or misses(after)
    return Explanation(found.before, after, slots, _count(pool), effective_share(after), others)
