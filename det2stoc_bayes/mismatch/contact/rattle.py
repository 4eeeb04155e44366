"""Hypotheses weighed by what recordings of their own would say, where simulations rattle.

A simulation rattles otherwise than the body did, so that what rattles less is told better, right or wrong: less
friction under the whole weight beats the buoyancy that was there. How far one hypothesis leads another is then no
measure of their odds, but a number that either would give on recordings which it makes (Cox, 1961, tests of separate
families of hypotheses; Wood, 2010, synthetic likelihood).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from jaxtyping import Float
from scipy import stats

from det2stoc_bayes.mismatch.contact.chances import alike, as_the_best
from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.pair import SKETCH, Pair, finished, next_to_nothing, sketched, with_memory
from det2stoc_bayes.mismatch.contact.replicas import complete, moved_freely
from det2stoc_bayes.mismatch.contact.screen import Promise
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.finding import SURE

PROMISED = 0.5  # of what the leader promises: who promises less is no rival,
MOST_RIVALS = 3  # nor who comes after so many
NUM_MADE = 3  # sets of recordings that each hypothesis makes,
FEW, CLEAR = 2, 7.0  # and so many of them where these give such odds (log): by a Student-t of 2 degrees of freedom


@dataclass(frozen=True, eq=False)
class Rival:
    """A hypothesis that another one leads, and its odds against that one (log)."""

    pair: Pair
    log_odds: float


def rattles(fit: ContactFit) -> bool:
    """Whether simulations move where the body does not: some column has no say, for no model tells it."""
    heard = fit.followed.heard
    return heard is not None and not heard.all()


def rivals(
    leader: Pair,
    fitted: Sequence[Pair],
    ground: ContactFit,
    screened: Sequence[Promise],
    luck: float,
    seed: int,
    progress: Callable[[str, int, int], None],
) -> tuple[Rival, ...]:
    """Those that promise much beside what the leader does, weighed against it.

    One of more parameters is none: it may say the same. Some are `fitted` already; what predicts the same as the
    leader is no rival. `ground` is where they were screened.
    """
    promised = next((s.gain for s in screened if s.placed == leader.placed), max((s.gain for s in screened), default=0))
    others = [s for s in screened if s.placed != leader.placed and s.placed.size <= leader.placed.size]
    worth = [s for s in others if s.gain > PROMISED * promised][:MOST_RIVALS]
    if not worth:
        return ()
    memory, known = leader.fit.followed.memory, {p.placed: p for p in fitted}
    led = at(ground.followed.remembering(memory), ground.z)
    led.prepare()

    def fit_of(promise: Promise) -> Pair:
        if promise.placed in known:
            return with_memory(known[promise.placed], memory)
        return finished(sketched(led, promise), leader.held.followed, luck)

    progress("weighing rivals", 0, 1 + len(worth))
    pairs = side_by_side(led.problem, fit_of, worth)
    asked = [p for p in pairs if p in fitted]  # before, how near they come to what the leader predicts
    pairs = asked + as_the_best([leader, *(p for p in pairs if p not in asked)], luck)[1:]
    pairs = [p for p in pairs if not alike(p, leader, luck)]
    made, alone, weighed = made_by(leader.fit, seed), cache(partial(refitted, leader.fit, luck=luck)), []
    for k, pair in enumerate(pairs):
        progress("weighing rivals", 1 + k, 1 + len(pairs))
        weighed.append(Rival(pair, log_odds(leader.fit, pair.fit, made, made_by(pair.fit, seed), luck, alone)))
    progress("weighing rivals", 1, 1)
    return tuple(weighed)


def likelier(weighed: Sequence[Rival]) -> Pair | None:
    """Who is surely likelier than the leader; None without one.

    What has more parameters may be ahead by what noise gives it, as an attraction from far off beside a tilt.
    """
    first = max(weighed, key=lambda r: r.log_odds, default=None)
    return None if first is None or first.log_odds < np.log(SURE / (1 - SURE)) else first.pair


def made_by(fit: ContactFit, seed: int) -> list[Followed]:
    """Sets of recordings that a hypothesis makes; none where its simulations diverge when nothing leads them."""
    made = [moved_freely(fit, np.random.default_rng([seed, 13, k])) for k in range(NUM_MADE)]
    return made if all(complete(m, fit) for m in made) else []


def log_odds(
    leader: ContactFit,
    rival: ContactFit,
    by_leader: Sequence[Followed],
    by_rival: Sequence[Followed],
    luck: float,
    alone: Callable[[Followed], ContactFit] | None = None,
) -> float:
    """Of a rival against its leader, by how far that leads on what was recorded and on what either of them made.

    Of few leads a predictive Student-t; they scatter by bumps, whose height (nats) is `luck`, at least. FEW are found
    first, all if these leave it open. Where one of them makes no recordings the lead itself is all there is. `alone`
    fits the leader, and may know what it has fitted.
    """
    leader.prepare()
    rival.prepare()
    alone = alone or partial(refitted, leader, luck=luck)
    memory = leader.followed.memory

    def leads(told: Sequence[Followed]) -> list[float]:
        return side_by_side(leader.problem, lambda f: refitted(rival, f, luck).loss - alone(f).loss, told)

    def on(some: slice) -> list[Followed]:
        return [m.remembering(memory) for made in (by_leader, by_rival) for m in made[some]]

    if not (by_leader and by_rival):
        return -leads([leader.followed])[0]
    there, *few = leads([leader.followed, *on(slice(FEW))])
    of_each = np.reshape(few, (2, -1))
    if abs(odds := _odds(there, of_each, luck)) >= CLEAR:
        return odds
    return _odds(there, np.hstack([of_each, np.reshape(leads(on(slice(FEW, None))), (2, -1))]), luck)


def _odds(there: float, of_each: Float[np.ndarray, "two made"], luck: float) -> float:
    """Log odds of what made the second row for a lead `there`, against what made the first one."""
    count = of_each.shape[1]
    scale = max(float(np.sqrt(of_each.var(1, ddof=1).mean())), luck) * np.sqrt(1 + 1 / count)
    by_first, by_second = stats.t.logpdf(there, 2 * (count - 1), of_each.mean(1), scale)
    return float(by_second - by_first)


def refitted(fit: ContactFit, followed: Followed, luck: float) -> ContactFit:
    """A hypothesis after a few steps on other recordings; all are asked so, those that were recorded as well."""
    there = followed.with_problem(followed.problem.with_effects(fit.problem.effects))
    return fit_followed(there, fit.z, iterations=SKETCH, like=fit, settled=next_to_nothing(luck))
