"""Additions to the believed model, judged by windows that were not fitted: what is named must tell those better."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.contact.exchange import exchanged
from det2stoc_bayes.mismatch.contact.pair import (
    Pair,
    added,
    added_fit,
    exchanged_pairs,
    resettled,
    without_last,
)
from det2stoc_bayes.mismatch.contact.replicas import replicated
from det2stoc_bayes.mismatch.contact.scales import certainty
from det2stoc_bayes.mismatch.contact.screen import Promise, screen
from det2stoc_bayes.mismatch.contact.window_fit import fit_windows
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.shortlist import shortlist

NUM_TRIED = 14  # the best candidates, where they would stand,
NUM_REFINED = 6  # of them, which are fitted:
NUM_PROMISING = 3  # those that promise most, though where they would stand starts are those of the believed model,
ALSO = 0.3  # of what an effect's best trial promises: what another of them must
NUM_SETTLED = 3  # of those fitted, which are fitted to the end
NEAR, LEAST_NEAR = 0.25, 20.0  # share of the best's gain, and nats, behind which they are not
LEAST_GAIN = 1.0  # nats below which a screened effect is not fitted
LEAST_CERTAIN = 3.0  # standard errors of the gain over windows: of those fitted
HELD_CERTAIN = 2.0  # and of those held out
FEW = 60.0  # nats: a gain which few windows may have, that by far is not chance's
HELD_GAIN = 3.0  # nats of it on windows held out
TIMES = 3.0  # what chance gains at most
NUM_CHANCES = 3  # data sets that the base itself makes
LUCK = 4.0  # nats by which fits of the same hypothesis differ
MAX_EFFECTS = 2
MOST_LEADERS = 2  # whose rivals are looked for where the leader ended
LEAST_WINDOWS = 8  # that are held out, or nothing is decided by them
Progress = Callable[[str, int, int], None]
Advance = Callable[[int], None]


@dataclass(frozen=True, eq=False)
class Round:
    """One look for a further effect: what was screened, what was fitted (best first), and what was taken."""

    base: Pair
    screened: tuple[Promise, ...]
    refined: tuple[Pair, ...]
    taken: Pair | None


def look(base: Pair, pool: Sequence[PlacedEffect], progress: Progress, seed: int = 0) -> Round:
    """Screen all, fit the few best, and take the best if windows that were not fitted ask for it.

    A leader, and its rivals, are looked for once more where it ended, for psi and starts there are others.
    """
    others = [p for p in pool if p not in base.fit.problem.effects]
    screened = screen(base.fit, others, _counted(progress, len(others)))
    found = refined(base, screened, progress)
    base, found = leading(base, found)
    seen: list[PlacedEffect] = []
    while found and found[0].placed not in seen and len(seen) < MOST_LEADERS and found[0].gain(base) > FEW:
        seen.append(found[0].placed)
        there = without_last(found[0])
        promises = screen(there.fit, others, _counted(progress, len(others)))
        base, found = leading(base, [*found, *refined(there, promises, progress)])
    rivals = [p.placed for p in found]
    chance = cache(lambda: gain_by_chance(base, rivals, seed, progress))  # which takes long, and is seldom asked for
    taken = next((p for p in found[:NUM_SETTLED] if earns(base, p, chance)), None)
    if taken is not None:
        base, found = settled_down(base, found, taken, progress)
        taken = found[0]
    return Round(base, tuple(screened), tuple(found), taken)


def settled_down(base: Pair, found: Sequence[Pair], taken: Pair, progress: Progress) -> tuple[Pair, list[Pair]]:
    """What is taken and those near it, fitted to the end, before they are compared; the best of them first."""
    near = taken.heights.sum() + max(NEAR * taken.gain(base), LEAST_NEAR)
    rivals = [p for p in found if p.heights.sum() < near][:NUM_SETTLED]
    rivals = rivals if taken in rivals else [*rivals, taken]
    done = []
    for k, rival in enumerate(rivals):
        progress("settling the best", k, len(rivals))
        done.append(resettled(rival))
    progress("settling the best", len(rivals), len(rivals))
    base, found = leading(base, [*done, *found])
    first = [p for p in found if p.placed in {r.placed for r in rivals}]
    return base, [*first, *(p for p in found if p not in first)]


def _counted(progress: Progress, total: int) -> Advance:
    done = [0]

    def advance(n: int) -> None:
        done[0] += n
        progress("screening effects", done[0], total)

    return advance


def refined(ground: Pair, screened: Sequence[Promise], progress: Progress) -> list[Pair]:
    """Those that promise most, and those that are best where they would stand, fitted.

    The first of all from every trial of it that promises something: an effect's rates and places have many optima.
    """
    worth = shortlist([s for s in screened if s.gain > LEAST_GAIN], NUM_TRIED)
    first, rest = worth[:NUM_PROMISING], worth[NUM_PROMISING:]
    rest.sort(key=lambda s: added_fit(ground.fit, s, iterations=0).loss)
    worth = [*first, *rest][:NUM_REFINED]
    worth += [o for s in worth[:1] for o in s.others if o.gain > ALSO * s.gain]
    here: list[Pair] = []
    for promise in worth:
        progress("refining the best", len(here), len(worth))
        here.append(added(ground, promise))
    if worth:
        progress("refining the best", len(worth), len(worth))
    return here


def leading(base: Pair, found: Sequence[Pair]) -> tuple[Pair, list[Pair]]:
    """All from the likeliest starts, the base apart; of each addition the best alone, best first."""
    base, *pairs = exchanged_pairs([base, *found])
    first: dict[PlacedEffect, Pair] = {}
    for pair in sorted(pairs, key=lambda p: p.heights.sum()):
        first.setdefault(pair.placed, pair)
    return base, list(first.values())


def earns(base: Pair, more: Pair, chance: Callable[[], float]) -> bool:
    """Whether an addition tells fitted and held-out windows better than chance does.

    Either most windows say so, or few do by far more than `chance`, what is gained on data of the base's own making.
    """
    if not (more.fit.z > more.fit.problem.floor + 1e-6).all():
        return False
    gains = base.heights - more.heights
    fitted = np.arange(len(gains)) < more.fit.windows.count
    sure = certainty(gains[fitted], more.owners[fitted])
    if more.held.windows.count < LEAST_WINDOWS:
        return sure > LEAST_CERTAIN + HELD_CERTAIN
    if sure >= LEAST_CERTAIN and certainty(gains[~fitted], more.owners[~fitted]) > HELD_CERTAIN:
        return True
    if gains.sum() <= FEW or gains[~fitted].sum() < HELD_GAIN:
        return False
    return bool(gains[fitted].sum() > TIMES * chance())


def gain_by_chance(base: Pair, rivals: Sequence[PlacedEffect], seed: int, progress: Progress) -> float:
    """The most that these gain on fitted windows as the base itself would make them."""
    best = 0.0
    for k in range(NUM_CHANCES):
        progress("measuring chance", k, NUM_CHANCES)
        windows = replicated(base.fit, np.random.default_rng([seed, 7, k]))
        fit = fit_windows(windows, base.fit.z, iterations=3)
        worth = [s for s in screen(fit, rivals) if s.gain > LEAST_GAIN][:NUM_SETTLED]
        fit, *rest = exchanged([fit, *(added_fit(fit, p) for p in worth)])
        best = max([best, *(float(fit.heights.sum() - more.heights.sum()) for more in rest)])
    progress("measuring chance", NUM_CHANCES, NUM_CHANCES)
    return best


def chances(pairs: Sequence[Pair], random: np.random.Generator, count: int = 4000) -> Float[np.ndarray, " pairs"]:
    """Chance of each hypothesis to tell recordings like these best, by the Bayesian bootstrap over recordings.

    Fits from other starts end a few nats apart: so much of a lead is luck.
    """
    _, groups = np.unique(pairs[0].owners, return_inverse=True)
    losses = np.stack([np.bincount(groups, p.heights) for p in pairs], 1)
    losses = losses + np.array([0.5 * p.placed.size for p in pairs]) / len(losses)
    weights = random.dirichlet(np.ones(len(losses)), count) * len(losses)
    best = (weights @ losses + LUCK * random.standard_normal((count, len(pairs)))).argmin(1)
    return np.bincount(best, minlength=len(pairs)) / count


def alike(a: Pair, b: Pair) -> Bool[np.ndarray, ""]:
    """Whether two hypotheses predict the same, within a small part of what they leave."""
    apart = (a.fit.errors - b.fit.errors) / a.fit.scales.values
    near = np.nanmean(np.minimum(apart**2, 9.0)) < 0.05
    return np.asarray(near and abs(certainty(a.heights - b.heights, a.owners)) < 2.0)
