"""Which screened candidates are fitted."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from det2stoc_bayes.mismatch.effects import PlacedEffect

NUM_OTHERS = 3  # under names that the best do not have


@runtime_checkable
class Candidate(Protocol):
    """Something that was screened for an effect."""

    @property
    def placed(self) -> PlacedEffect:
        """The effect and its element."""
        ...


def shortlist[C: Candidate](worth: Sequence[C], best: int) -> list[C]:
    """The best, and the best of effects that are not among them: the same law on other elements crowds others out."""
    first = list(worth[:best])
    names = {s.placed.effect.name for s in first}
    for s in worth[best:]:
        if s.placed.effect.name not in names and len(first) < best + NUM_OTHERS:
            first.append(s)
            names.add(s.placed.effect.name)
    return first
