"""Additions to the believed model, judged by recordings that were not fitted: what is named must tell those better."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from det2stoc_bayes.mismatch.contact.chances import LEAST_NEAR, LUCK, as_the_best, best_of_each
from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, fit_followed
from det2stoc_bayes.mismatch.contact.merit import HELD_GAIN, earns, gain_by_chance, held_gain
from det2stoc_bayes.mismatch.contact.pair import (
    SKETCH,
    Pair,
    caught_up,
    finished,
    nearer,
    on_all,
    paired,
    remembered,
    remembering_more,
    sketched,
    without_last,
)
from det2stoc_bayes.mismatch.contact.polish import BUMPY, polished
from det2stoc_bayes.mismatch.contact.rattle import Rival, likelier, rattles, rivals
from det2stoc_bayes.mismatch.contact.screen import Promise, promising_more, screen, some
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.contact.top import bumps
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.race import threshold
from det2stoc_bayes.mismatch.shortlist import shortlist
from det2stoc_bayes.problem import Problem

NUM_SKETCHED = 10  # the most promising candidates, of which some steps are made,
NUM_REFINED = 5  # and the best of them, which are fitted to the end
ALSO = 0.3  # of what an effect's best trial promises: what another of them must
BEGUN, DRAWN, FITTED = 0.2, 0.4, 0.6  # of the best's gain: who has less after a step, a sketch, some steps on all
LEAST_PROMISE = 0.3  # of what an addition must earn: what is screened at less is not fitted
MOST_AGAIN = 20  # candidates that are screened anew where a leader ended
NEAR = 0.3  # share of the best's gain behind which none comes near any more
CONTENDS = 0.5  # of the best's gain: who has more may have ended on a bump
SO_HIGH = 10.0  # times as high as bumps: a lead that they do not turn
CALM = 0.5  # of the height of the base's bumps: lower ones about an addition,
MOST_FURTHER = 3  # times that it goes beyond them and on
MAX_EFFECTS = 3
LOOK_AGAIN = 30.0  # nats of a leader, whose rivals are looked for once more where it ended,
MOVED = 0.1  # if psi has moved by so many prior sds there: else they promise what they did
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Round:
    """One look for a further effect: what was screened, what was fitted (best first), and what was taken."""

    base: Pair
    screened: tuple[Promise, ...]
    refined: tuple[Pair, ...]
    taken: Pair | None
    luck: float = LUCK  # nats by which fits of the same hypothesis differ
    rivals: tuple[Rival, ...] = ()  # of the likeliest, which likelihood alone does not tell from it
    leader: Pair | None = None  # that likeliest one, where a rival was taken in its place


def look(
    base: Pair,
    pool: Sequence[PlacedEffect],
    progress: Progress,
    seed: int = 0,
    matters: Callable[[Pair, Pair, Sequence[Pair]], bool] = lambda *_: True,
) -> Round:
    """Screen all, fit the few best, and take the best if recordings that were not fitted ask for it.

    The base goes beyond its bumps first, and to where its best addition leads it: neither is an addition's merit. A
    leader's rivals are looked for once more where it ended, for psi is another there. Where simulations rattle, who
    is surely likelier by recordings of its own is taken in its place, if it or who is near it `matters`.
    """
    others = [p for p in pool if p not in base.fit.problem.effects]
    progress("measuring bumps", 0, 1)
    first_luck = max(LUCK, bumps(base.fit, np.random.default_rng([seed, 4])))
    first = beyond_bumps(base, first_luck)
    progress("measuring bumps", 1, 1)
    ground = nearer(first.fit)
    screened = _screened(ground, others, progress)
    least = LEAST_PROMISE * threshold(len(others))
    found = refined(first, ground, [s for s in screened if s.gain > least], first_luck, progress)
    there, latest = ground, screened
    if found and found[0].gain(first) > max(LOOK_AGAIN, first_luck):
        there = nearer(without_last(found[0], ground.followed.memory))
    if np.abs(there.z - ground.z).max(initial=0.0) > MOVED:
        latest = _screened(there, [s.placed for s in screened[:MOST_AGAIN]], progress)
        more = promising_more(found[0].placed, screened, [s for s in latest if s.gain > least])
        again = refined(first, there, more, first_luck, progress, found) if more else []
        found = best_of_each([*found, *again])
    base = better_base(first, found, first_luck, longer=False)
    if not found or found[0].gain(base) <= -first_luck:  # for additions are not beyond their bumps yet
        return Round(base, tuple(screened), tuple(found), None, first_luck)
    short = {p.placed: p for p in found}
    found = near_remembered(base, found, first_luck, progress)
    base = better_base(base, found, first_luck, longer=True)
    luck = bumps_about(found[:1], seed)
    if luck <= CALM * first_luck:
        found = fitted_on(base, found, luck, progress)
        luck = bumps_about(_near(base, found), seed)
        base = better_base(base, found, first_luck, longer=True)
    else:
        luck = max(luck, first_luck)
    found = smoothed(base, found, luck, progress)
    if first_luck < BUMPY and found[0].gain(base) < SO_HIGH * luck:
        base = beyond_bumps(base, luck)
    chance = partial(gain_by_chance, base, [p.placed for p in found], seed, progress, luck)
    needed = max(threshold(len(others)), luck)
    taken = found[0] if earns(base, found[0], needed, chance) else None
    longer = found[0].fit.followed.memory > short[found[0].placed].fit.followed.memory
    if taken is None and longer and held_gain(base, found[0]) < HELD_GAIN:
        # That memory may serve the fitted recordings alone: then all are asked with the one they had first.
        first = as_the_best(best_of_each([short[p.placed] for p in found]), luck)
        if first[0].placed == found[0].placed and earns(base, first[0], needed, chance):
            found, taken = first, first[0]
    if taken is None or not rattles(base.fit) or not matters(base, taken, _near(base, found)):
        return Round(base, tuple(screened), tuple(found), taken, luck)
    weighed = rivals(taken, found, there, latest, luck, seed, progress)
    leader, tried = None, best_of_each([*found, *(r.pair for r in weighed)])
    if (first := likelier(weighed)) is not None:
        known = partial(gain_by_chance, base, [p.placed for p in tried], seed, progress, luck)
        leader, taken = (taken, first) if earns(base, first, needed, known) else (leader, taken)
    tried = [taken if p.placed == taken.placed else p for p in tried]
    return Round(base, tuple(screened), tuple(tried), taken, luck, weighed, leader)


def beyond_bumps(pair: Pair, luck: float) -> Pair:
    """The same hypothesis beyond its nearest bumps, where these are high."""
    fit = polished(pair.fit) if luck >= BUMPY else pair.fit
    return pair if fit is pair.fit else paired(fit, pair.held.followed)


def better_base(base: Pair, found: Sequence[Pair], luck: float, *, longer: bool) -> Pair:
    """The base from where its best addition led psi, if it is told better there.

    Perhaps with a `longer` memory, and then beyond its bumps.
    """
    if not found:
        return base
    there = without_last(found[0], found[0].fit.followed.memory)
    other = paired(fit_followed(there.followed, there.z, like=base.fit), base.held.followed)
    other = remembered(other) if longer else other
    if longer and found[0].gain(other) < SO_HIGH * luck:
        other = beyond_bumps(other, luck)
    return min((base, other), key=lambda p: p.height)


def _screened(fit: ContactFit, pool: Sequence[PlacedEffect], progress: Progress) -> list[Promise]:
    done = [0]

    def advance(n: int) -> None:
        done[0] += n
        progress("screening effects", done[0], len(pool))

    return screen(fit, pool, advance)


def refined(
    base: Pair,
    ground: ContactFit,
    screened: Sequence[Promise],
    luck: float,
    progress: Progress,
    known: Sequence[Pair] = (),
) -> list[Pair]:
    """Those that promise most, sketched, and of these the best, fitted; the first from each of its sketches.

    Who falls far behind on some of the recordings is left there, after a first step or a sketch, beyond what `luck`
    does there. What leads psi back from where the ground has it is no addition's merit. A sketch that only comes back
    to what is `known` is not fitted again.
    """
    worth = shortlist(screened, NUM_SKETCHED)
    worth += [o for s in worth[:3] for o in s.others if o.gain > ALSO * s.gain]
    few = some(ground)
    slack = luck * np.sqrt(few.problem.segments.count / base.fit.problem.segments.count)
    alone = fit_followed(few.followed, few.z, iterations=1, like=few)
    stayed = at(few.followed, base.fit.z).loss
    tell = partial(_each, base.fit, progress=progress, total=2 * (len(worth) + NUM_REFINED))
    begun = in_reach(tell(lambda p: sketched(few, p, iterations=1), worth, 0), alone.loss, BEGUN, slack)
    sketches = tell(lambda f: fit_followed(f.followed, f.z, iterations=SKETCH - 1, like=f), begun, len(worth))
    alone = fit_followed(few.followed, alone.z, iterations=SKETCH - 1, like=alone)
    sketches = in_reach(sketches, min(alone.loss, stayed), DRAWN, slack)
    sketches.sort(key=lambda f: f.loss)
    best = {s.problem.effects[-1]: s for s in reversed(sketches)}
    chosen = sorted(best.values(), key=lambda f: f.loss)[:NUM_REFINED]
    chosen += [s for s in sketches if s.problem.effects == chosen[0].problem.effects and s is not chosen[0]]
    fitted = {p.placed: at(few.followed.with_problem(_adding(few, p.placed)), p.fit.z).loss for p in known}
    chosen = [s for s in chosen if s.loss < fitted.get(s.problem.effects[-1], np.inf) - slack]
    whole = tell(lambda f: on_all(f, ground), chosen, 2 * len(worth))
    ends = in_reach([*whole, *(p.fit for p in known)], min(ground.loss, base.fit.loss), FITTED, luck)
    whole = [f for f in whole if f in ends]
    pairs = tell(lambda f: finished(f, base.held.followed, luck), whole, 2 * len(worth) + NUM_REFINED)
    progress("refining the best", 1, 1)
    return best_of_each(pairs)


def _adding(fit: ContactFit, placed: PlacedEffect) -> Problem:
    """A fit's hypothesis with one more effect."""
    return fit.problem.with_effects((*fit.problem.effects, placed))


def in_reach(fits: Sequence[ContactFit], bare: float, part: float, slack: float) -> list[ContactFit]:
    """Those that gain such a part of the best's gain over what is `bare`, and those at most so many nats behind it."""
    best = max((bare - f.loss for f in fits), default=0.0)
    return [f for f in fits if bare - f.loss >= best - max((1 - part) * abs(best), slack)]


def _each[T, S](
    fit: ContactFit, make: Callable[[T], S], items: Sequence[T], begun: int, *, progress: Progress, total: int
) -> list[S]:
    """What is made of each, the progress of it told."""
    return side_by_side(fit.problem, make, items, lambda k: progress("refining the best", begun + k, total))


def near_remembered(base: Pair, found: Sequence[Pair], luck: float, progress: Progress) -> list[Pair]:
    """Best first, those that come near the best each with the memory that serves it best.

    A short memory forgives what is wrong: with a longer one the right effect gains most. Who gains much and ended on a
    bump, which no longer memory serves, is fitted with the best's from where it predicts as that does.
    """
    near = _near(base, found)
    contending = {p.placed for p in found if p.gain(base) > CONTENDS * found[0].gain(base)}
    tell, whole = partial(progress, "remembering longer"), len(near) + len(contending)
    longer = side_by_side(base.fit.problem, partial(longest, luck=luck), near, lambda k: tell(k, whole))
    best, *others = best_of_each([*found, *longer])
    behind = [p for p in others if p.placed in contending and p.fit.followed.memory < best.fit.followed.memory]
    led = side_by_side(base.fit.problem, partial(caught_up, leader=best), behind, lambda k: tell(len(near) + k, whole))
    tell(1, 1)
    return best_of_each([best, *others, *led])


def longest(pair: Pair, luck: float) -> Pair:
    """The same hypothesis with the memory that serves it best."""
    best, now = pair, remembering_more(pair, luck)
    while now is not None:
        best, now = min((best, now), key=lambda p: p.height), remembering_more(now, luck)
    return best


def _near(base: Pair, found: Sequence[Pair]) -> list[Pair]:
    """Those that come near the first."""
    return [p for p in found if p.height <= found[0].height + max(NEAR * found[0].gain(base), LEAST_NEAR)]


def bumps_about(pairs: Sequence[Pair], seed: int) -> float:
    """How high the highest bumps about them are, nats: by so much fits of one hypothesis may differ."""
    return max([LUCK, *(bumps(p.fit, np.random.default_rng([seed, 5])) for p in pairs)])


def fitted_on(base: Pair, found: Sequence[Pair], luck: float, progress: Progress) -> list[Pair]:
    """Best first, those near the best fitted on by the bumps about it, which the base's do not hide any more.

    Where it leads out of what rattles, steps that were nothing beside the base's bumps are worth while.
    """
    near, tell = _near(base, found), partial(progress, "refining the best")

    def further(pair: Pair) -> Pair:
        for _ in range(MOST_FURTHER):
            fit = polished(pair.fit) if luck >= BUMPY else pair.fit
            more = finished(fit, base.held.followed, luck)
            if more.height > pair.height - luck:
                return min((pair, more), key=lambda p: p.height)
            pair = more
        return pair

    done = side_by_side(base.fit.problem, further, near, lambda k: tell(k, len(near)))
    tell(1, 1)
    return near_remembered(base, best_of_each([*found, *done]), luck, progress)


def smoothed(base: Pair, found: Sequence[Pair], luck: float, progress: Progress) -> list[Pair]:
    """Those near the best beyond their nearest bumps, so many nats high, best first.

    Where a lead is many times as high nobody goes beyond them: the order would stay.
    """
    near, ahead = _near(base, found), found[0].height + SO_HIGH * luck
    contested = [p for p in near if p.height < ahead]
    if len(contested) == 1 and base.height > ahead:
        contested = []
    beyond = partial(beyond_bumps, luck=luck)
    done = side_by_side(base.fit.problem, beyond, contested, lambda k: progress("polishing", k, len(contested)))
    progress("polishing", 1, 1)
    done += [p for p in near if p not in contested]
    alone = as_the_best(best_of_each(done), luck)
    return best_of_each([*alone, *(p for p in found if p not in near)])
