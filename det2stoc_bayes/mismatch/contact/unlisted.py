"""A force of any shape on a joint, in the place of listed laws on it that leave more than chance.

A curve has dozens of unknowns, each of which takes simulations where bodies touch: it is looked for last, and on joints
alone on which listed laws were found.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.led_response import LedResponse
from det2stoc_bayes.mismatch.contact.merit import HELD_GAIN, LEAST_CERTAIN, held_gain
from det2stoc_bayes.mismatch.contact.pair import Pair, caught_up, finished, sketched
from det2stoc_bayes.mismatch.contact.scales import certainty
from det2stoc_bayes.mismatch.contact.screen import Promise
from det2stoc_bayes.mismatch.contact.search import Progress, Round, longest
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.effects.base import SMALL, PlacedEffect
from det2stoc_bayes.mismatch.effects.elements import Element, Typical
from det2stoc_bayes.mismatch.effects.unlisted import FORMS, UnlistedForce
from det2stoc_bayes.mismatch.evidence import log_det
from det2stoc_bayes.mismatch.race import threshold
from det2stoc_bayes.mismatch.unlisted_screen import reach_of, shapes

NUM_FITTED = 2  # of the curves that promise most
PROMISING = 0.5  # of what the best of all promises: a curve that promises less is not fitted


def joints_of(effects: Sequence[PlacedEffect]) -> list[tuple[Element, Typical]]:
    """The joints that these effects sit on, and what is typical there."""
    return list(dict.fromkeys((e.element, e.typical) for e in effects if e.element.kind == "joint"))


def with_curves(
    rounds: Sequence[Round], after: Pair, by_steps_of: Callable[[Pair, Pair], Pair], progress: Progress
) -> list[Round]:
    """The rounds that led to `after`; where a curve surely tells more, one alone in which it is taken instead.

    Who is ahead but not surely stands beside what was taken last. `by_steps_of` gives a hypothesis another's steps.
    """
    taken = [r for r in rounds if r.taken is not None]
    first, last = taken[0], taken[-1]
    luck = max(r.luck for r in taken)
    found = curves(first, after, luck, progress)
    if not found:
        return list(rounds)
    needed, curve = max(threshold(len(first.screened)), luck), by_steps_of(after, found[0])
    ways = (after, caught_up(after, curve))
    if min(lead(curve, listed) for listed in ways) < needed:
        return list(rounds)
    if all(surely(curve, listed) for listed in ways):
        return [replace(first, refined=(*found, *first.refined), taken=found[0], rivals=(), leader=None)]
    return [replace(r, refined=(*r.refined, found[0])) if r is last else r for r in rounds]


def curves(first: Round, after: Pair, luck: float, progress: Progress) -> list[Pair]:
    """Curves beside a round's base, in the place of what `after` adds to it on joints, best first."""
    fit, held = first.base.fit, first.base.held.followed
    added = after.fit.problem.effects[len(fit.problem.effects) :]
    promised = screened(fit, joints_of(added))
    least = PROMISING * max([0.0, *(p.gain for p in promised), *(s.gain for s in first.screened if s.placed in added)])
    worth = [p for p in promised if p.gain > least][:NUM_FITTED]

    def fitted(promise: Promise) -> Pair:
        return longest(finished(sketched(fit, promise), held, luck), luck)

    tell = partial(progress, "fitting curves")
    found = side_by_side(fit.problem, fitted, worth, lambda k: tell(k, len(worth)))
    tell(1, 1)
    return sorted(found, key=lambda p: p.height)


def lead(curve: Pair, listed: Pair) -> float:
    """Nats by which a curve tells recordings better than listed laws, less one for each unknown that it has more.

    Their priors have no say: a listed law of unusual size is no less that law, and a curve's prior suits its size.
    """
    return float((listed.losses - curve.losses).sum()) - (curve.fit.problem.size - listed.fit.problem.size)


def surely(curve: Pair, listed: Pair) -> bool:
    """Whether most recordings have a curve ahead, and those held out do."""
    sure = certainty(listed.losses - curve.losses, curve.owners) >= LEAST_CERTAIN
    return sure and held_gain(listed, curve) >= HELD_GAIN


def screened(fit: ContactFit, places: Sequence[tuple[Element, Typical]]) -> list[Promise]:
    """The best curve on each joint over each variable, most evidence first."""
    led = LedResponse(fit)
    forms = [f for f in FORMS if len(f.variables) == 1]
    tried = [_best(fit, led, at, typical, f) for at, typical in places for f in forms if f().fits(at)]
    return sorted((p for p in tried if p is not None), key=lambda p: -p.gain)


def _best(
    fit: ContactFit, led: LedResponse, at: Element, typical: Typical, form: type[UnlistedForce]
) -> Promise | None:
    """The curve whose smoothness and size, of a few, earn most; None where the variable stands still.

    Evidence is in closed form, as far as predictions are linear in the curve and psi.
    """
    low, high = reach_of(form().along(led.joint_states(at))[led.real])
    if low == high:
        return None
    effect = form(((low, high),))
    given, small = effect.given(typical), SMALL * typical.force
    knots = [{"curve": knot, **given} for knot in small * np.eye(len(effect.modes))]
    columns = fit.weighed(led.lessened(PlacedEffect(effect, at, typical), knots) / small)
    share = np.linalg.solve(fit.gram, np.einsum("wnk,wnl->kl", fit.told, columns))
    beside = columns - fit.told @ share
    inner = np.einsum("wnk,wnl->kl", beside, beside)
    total = np.einsum("wnk,wn->k", beside, fit.left)
    best: Promise | None = None
    for shape in shapes(form, ((low, high),)):
        root = shape.root(typical)
        precise, pull = root.T @ inner @ root + np.eye(root.shape[1]), root.T @ total
        z = np.linalg.solve(precise, pull)
        earned = float(0.5 * pull @ z - 0.5 * log_det(precise))
        if best is None or earned > best.gain:
            curve = root @ z
            best = Promise(PlacedEffect(shape, at, typical), earned, {"curve": curve, **given}, -share @ curve)
    return best
