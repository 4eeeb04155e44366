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
from det2stoc_bayes.mismatch.contact.merit import earns
from det2stoc_bayes.mismatch.contact.pair import Pair, caught_up, finished, sketched
from det2stoc_bayes.mismatch.contact.rattle import Rival
from det2stoc_bayes.mismatch.contact.screen import Promise, at_once
from det2stoc_bayes.mismatch.contact.search import Progress, Round, longest
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.effects.base import SMALL, PlacedEffect
from det2stoc_bayes.mismatch.effects.elements import Element, Typical
from det2stoc_bayes.mismatch.effects.unlisted import FORMS, UnlistedForce
from det2stoc_bayes.mismatch.evidence import log_det
from det2stoc_bayes.mismatch.race import threshold
from det2stoc_bayes.mismatch.unlisted_screen import joints, reach_of, shapes

NUM_FITTED = 2  # of the curves that promise most
PROMISING = 0.5  # of what the first of them promises: a curve that promises less is not fitted
EVEN = 0.0  # log odds


def with_curves(
    rounds: Sequence[Round],
    after: Pair,
    pool: Sequence[PlacedEffect],
    by_steps_of: Callable[[Pair, Pair], Pair],
    progress: Progress,
) -> list[Round]:
    """The rounds that led to `after`; where the likeliest curve surely tells more, one alone in which it is taken.

    Where it is ahead, but not surely, nothing that was taken on its joint is sure: it has even odds there.
    `by_steps_of` gives a hypothesis another's steps.
    """
    taken = [r for r in rounds if r.taken is not None]
    first, luck = taken[0], max(r.luck for r in taken)
    found = curves(first.base, after, pool, luck, progress)
    if not found:
        return list(rounds)
    needed, curve = max(threshold(len(first.screened)), luck), by_steps_of(after, found[0])
    ways = (after, caught_up(after, curve))
    if min(lead(curve, listed) for listed in ways) < needed:
        return list(rounds)
    # Most blocks must say so: of few, chance is taken to gain whatever is gained.
    if all(earns(listed, curve, needed, lambda most: most) for listed in ways):
        return [replace(first, refined=(*found, *first.refined), taken=found[0], rivals=(), leader=None)]
    rival = Rival(found[0], EVEN)
    return [replace(r, rivals=(*r.rivals, rival)) if _on_joint_of(r, rival.pair) else r for r in rounds]


def curves(base: Pair, after: Pair, pool: Sequence[PlacedEffect], luck: float, progress: Progress) -> list[Pair]:
    """Curves beside a base, in the place of what `after` adds to it on joints, best first."""
    fit, held = base.fit, base.held.followed
    on = {e.element.name for e in after.fit.problem.effects[len(fit.problem.effects) :] if e.element.kind == "joint"}
    places = [(at, typical) for at, typical in joints(pool) if at.name in on]
    promised = screened(fit, places) if places else []
    worth = [p for p in promised if p.gain > PROMISING * promised[0].gain > 0][:NUM_FITTED]
    if not worth:
        return []

    def fitted(promise: Promise) -> Pair:
        return longest(finished(sketched(fit, promise), held, luck), luck)

    tell = partial(progress, "fitting curves")
    found = side_by_side(fit.problem, fitted, worth, lambda k: tell(k, len(worth)))
    tell(1, 1)
    return sorted(found, key=lambda p: p.height)


def lead(curve: Pair, listed: Pair) -> float:
    """Nats by which a curve is likelier than listed laws whose size and other parameters no prior holds back.

    A listed law of unusual size is no less that law; the prior of a curve was chosen for its size.
    """
    return float(listed.losses.sum()) + 0.5 * log_det(listed.fit.gram) - curve.height


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
    given, small, room = effect.given(typical), SMALL * typical.force, at_once(led)
    knots = [{"curve": knot, **given} for knot in small * np.eye(len(effect.modes))]
    some = [knots[k : k + room] for k in range(0, len(knots), room)]
    told = [fit.weighed(led.lessened(PlacedEffect(effect, at, typical), s) / small) for s in some]
    beside, share = fit.beside(np.concatenate(told, -1))
    inner, total = np.einsum("wnk,wnl->kl", beside, beside), np.einsum("wnk,wn->k", beside, fit.left)
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


def _on_joint_of(one: Round, curve: Pair) -> bool:
    """Whether what a round took sits on the joint of a curve."""
    own = one.taken and one.taken.placed.element
    return own is not None and (own.kind, own.name) == ("joint", curve.placed.element.name)
