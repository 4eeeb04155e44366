"""How probable fitted hypotheses are beside each other, and which of them predict the same."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.contact.fit import at
from det2stoc_bayes.mismatch.contact.mimic import apart, mimicking
from det2stoc_bayes.mismatch.contact.pair import Pair, paired
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.effects import PlacedEffect

ALIKE = 0.05  # mean squared difference of predictions, in noise sds, of what no sample tells apart
LEAST_NEAR = 30.0  # nats behind the best within which what is equivalent may end
LUCK = 2.0  # nats by which fits of the same hypothesis differ where the likelihood has no bumps


def chances(
    pairs: Sequence[Pair], random: np.random.Generator, luck: float = LUCK, count: int = 4000
) -> Float[np.ndarray, " pairs"]:
    """Chance of each hypothesis to tell recordings like these best, by the Bayesian bootstrap over recordings.

    Fits from other starts end some nats apart: so much of a lead is luck.
    """
    _, groups = np.unique(pairs[0].owners, return_inverse=True)
    losses = np.stack([np.bincount(groups, p.losses) for p in pairs], 1)
    rest = np.array([p.height - p.losses.sum() for p in pairs])
    weights = random.dirichlet(np.ones(len(losses)), count) * len(losses)
    best = (weights @ losses + rest + luck * random.standard_normal((count, len(pairs)))).argmin(1)
    return np.bincount(best, minlength=len(pairs)) / count


def alike(a: Pair, b: Pair, luck: float = LUCK) -> Bool[np.ndarray, ""]:
    """Whether two hypotheses predict the same, within a small part of the noise."""
    if a.fit.followed.memory != b.fit.followed.memory or apart(a.fit, b.fit) >= ALIKE:
        return np.asarray(False)
    return np.asarray(abs(a.height - b.height) <= luck)


def as_the_best(pairs: Sequence[Pair], luck: float = LUCK) -> list[Pair]:
    """What can predict as the best does, where it does: equivalent effects would end nats apart, on other bumps."""
    first, *others = pairs
    first.fit.prepare()

    def mimic(rival: Pair) -> Pair:
        if rival.height > first.height + LEAST_NEAR:
            return rival
        led, memory = rival.fit, first.fit.followed.memory
        led = led if led.followed.memory == memory else at(led.followed.remembering(memory), led.z)
        same = paired(mimicking(led, first.fit), rival.held.followed)
        return same if alike(same, first, luck) else rival

    return [first, *side_by_side(first.fit.problem, mimic, others)]


def best_of_each(pairs: Sequence[Pair]) -> list[Pair]:
    """Of each addition the best fit alone, best first."""
    first: dict[PlacedEffect, Pair] = {}
    for pair in sorted(pairs, key=lambda p: p.height):
        first.setdefault(pair.placed, pair)
    return list(first.values())
