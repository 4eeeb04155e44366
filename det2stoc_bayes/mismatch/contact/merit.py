"""Whether an addition earns its place: by recordings that were not fitted, and beyond what chance gains."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import fit_followed
from det2stoc_bayes.mismatch.contact.pair import Pair, sketched
from det2stoc_bayes.mismatch.contact.replicas import made_alone, replicated
from det2stoc_bayes.mismatch.contact.scales import certainty
from det2stoc_bayes.mismatch.contact.screen import screen
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.contact.yardstick import LEAST_BLOCKS
from det2stoc_bayes.mismatch.effects import PlacedEffect

LEAST_CERTAIN = 3.0  # standard errors of the gain over blocks: of those fitted
HELD_GAIN = 3.0  # nats of it on recordings held out
TIMES = 3.0  # what chance gains at most
MAKERS = (made_alone, replicated) * 2  # of the data sets that the base itself makes
FAR_BELOW, FEWEST = 0.2, 2  # of what is asked for: by so many sets that gain no more, others are not made


def earns(base: Pair, more: Pair, needed: float, chance: Callable[[float], float]) -> bool:
    """Whether an addition tells fitted and held-out recordings better than chance does.

    Either most blocks say so, or few do by far more than `chance`: what is gained on data of the base's own making,
    looked for until it is too much.
    """
    if not (more.fit.z > more.fit.problem.floor + 1e-6).all() or more.gain(base) < needed:
        return False
    gains = base.losses - more.losses
    fitted = np.arange(len(gains)) < more.fit.followed.count
    sure = certainty(gains[fitted], more.owners[fitted])
    if more.held.followed.count < LEAST_BLOCKS:
        return sure > 2 * LEAST_CERTAIN
    if held_gain(base, more) < HELD_GAIN or gains[fitted].sum() < needed * fitted.mean():
        return False  # what is gained on the one alone is no merit of the addition
    most = float(gains[fitted].sum()) / TIMES
    return sure >= LEAST_CERTAIN or chance(most) < most


def held_gain(base: Pair, more: Pair) -> float:
    """Nats that an addition gains on recordings held out."""
    return float(base.held.losses.sum() - more.held.losses.sum())


def gain_by_chance(
    base: Pair,
    rivals: Sequence[PlacedEffect],
    seed: int,
    progress: Callable[[str, int, int], None],
    luck: float,
    most: float = np.inf,
) -> float:
    """The most that these gain on fitted recordings as the base would make them; looked for until it is `most`, or
    nowhere near.

    Half of the sets nothing leads: who gains on recordings of a body that nothing led by what leading does to one that
    rolls or rattles, gains there as well; but free motion may leave what was recorded. At least `luck`, the height of
    bumps: where something is missing they may be higher than on any recordings that the base makes.
    """
    best = luck
    for k, make in enumerate(MAKERS):
        if best >= most or (k >= FEWEST and best < FAR_BELOW * most < np.inf):
            break
        progress("measuring chance", k, len(MAKERS))
        followed = make(base.fit, np.random.default_rng([seed, 7, k]))
        fit = fit_followed(followed, base.fit.z, iterations=3, like=base.fit)
        worth = screen(fit, rivals)
        fits = side_by_side(fit.problem, partial(sketched, fit), worth)
        best = max([best, *(float(fit.losses.sum() - f.losses.sum()) for f in fits)])
    progress("measuring chance", 1, 1)
    return best
