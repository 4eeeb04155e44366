"""Trials about the best ones, closer and closer: where a few, wide apart, only show the way to a point in space."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.effects.base import PlacedEffect, Trial

REACHES = (0.6, 0.3, 0.15, 0.07)
MOST_STEPS = 4  # at each of them
WORTH_A_STEP = 1.0  # nats
ALIKE = 0.9  # cosine of what two trials change, from which on they are one neighbourhood


def leads(placed: PlacedEffect, trial: Trial) -> bool:
    """Whether a trial has others about it."""
    return len(placed.effect.about(trial, placed.typical, REACHES[0])) > 0


def sharpened[T](start: T, about: Callable[[T, float], Sequence[T]], worth: Callable[[T], float]) -> T:
    """The best to which a pattern search leads (Hooke and Jeeves, 1961); `worth` in nats."""
    best = start
    for reach in REACHES:
        for _ in range(MOST_STEPS):
            ahead = max([best, *about(best, reach)], key=worth)
            better, best = worth(ahead) - worth(best), ahead
            if better < WORTH_A_STEP:
                break
    return best


def unlike[T](ranked: Iterable[T], change: Callable[[T], Float[np.ndarray, " values"]], most: int) -> list[T]:
    """The first of all that change the prediction alike; those that change nothing are passed over."""
    out: list[T] = []
    told: list[Float[np.ndarray, " values"]] = []
    for s in ranked:
        moved = change(s)
        size = np.linalg.norm(moved)
        if size > 0 and all(moved @ other < ALIKE * size for other in told):
            out.append(s)
            told.append(moved / size)
        if len(out) == most:
            break
    return out
