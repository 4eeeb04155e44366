"""Looks at what could stand beside a fit, each taken once, however often the search comes by."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any

from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.horizon import extend
from det2stoc_bayes.mismatch.pairs import pairs
from det2stoc_bayes.mismatch.race import Slot
from det2stoc_bayes.mismatch.refine import Progress, look, look_again, refine_pairs
from det2stoc_bayes.mismatch.screen import Screened
from det2stoc_bayes.optimize import Fit

NUM_TRUER = 2  # pairs that are fitted beside one that leaves but chance
type Hypothesis = tuple[frozenset[PlacedEffect], tuple[tuple[int, int], bytes]]  # effects, and segments


class Looks:
    """Slots and pairs by the effects and the segments of the fit that they stand beside."""

    def __init__(self, progress: Progress = lambda *_: None):
        self.progress = progress
        self.others_chose = False  # recordings that were not fitted decided between additions
        self._slots: dict[Hypothesis, tuple[frozenset[PlacedEffect], Slot]] = {}
        self._pairs: dict[Hypothesis, dict[frozenset[PlacedEffect], Fit | None]] = {}
        self._extended: dict[int, tuple[Fit, Fit]] = {}
        self._found: dict[tuple[Hypothesis, Hashable], Any] = {}
        self._begun, self._first = 0, 0  # steps simulated before the first look, and by it

    def at(self, base: Fit, pool: Sequence[PlacedEffect], present: Fit | None = None) -> Slot:
        """Candidates of the pool beside a fit; of a pool that has grown since, beside the fit anew.

        Where they are to take the place of one `present`, only those that may are refined; such a look is not kept.
        """
        seen, known = self._slots.get(_key(base), (frozenset(), None))
        if known is not None and seen.issuperset(pool):
            return look_again(known, pool, self.progress, present)
        counter = base.problem.simulator.counter
        begun = counter.steps
        slot = look(base, pool, self.progress, present)
        if not self._first:
            self._begun, self._first = begun, counter.steps - begun
        if present is None:
            self._slots[_key(base)] = frozenset(pool), slot
        return slot

    def spent(self, fit: Fit) -> float:
        """Steps simulated since the first look began, in those that it took; 0 before it."""
        return (fit.problem.simulator.counter.steps - self._begun) / self._first if self._first else 0.0

    def extended(self, fit: Fit) -> Fit:
        """The same hypothesis at a longer horizon, where one has become possible."""
        if id(fit) not in self._extended:
            self._extended[id(fit)] = fit, extend(fit)
        return self._extended[id(fit)][1]

    def once[T](self, base: Fit, what: Hashable, find: Callable[[], T]) -> T:
        """What is found beside a fit, when it is asked for first."""
        key = _key(base), what
        if key not in self._found:
            self._found[key] = find()
        return self._found[key]

    def know(self, slot: Slot, pool: Sequence[PlacedEffect]) -> None:
        """Takes over what was seen before of a pool beside the slot's fit."""
        self._slots[_key(slot.base)] = frozenset(pool), slot

    def pairs(self, base: Fit, screened: Sequence[Screened], least: float, most: int) -> list[Fit]:
        """Fits with two additions at once, best first, of at most `most`; those that lost before do not run again."""
        return refine_pairs(base, screened, least, self._pairs.setdefault(_key(base), {}), most)

    def truer_pairs(self, base: Fit, screened: Sequence[Screened], found: Fit, more: float) -> list[Fit]:
        """The few pairs fitted that screening says to tell clearly more than the last two effects found, best first."""
        own = frozenset(found.problem.effects[-2:])
        promised = max((p.log_evidence for p in pairs(base, screened) if p.key == own), default=0.0)
        return self.pairs(base, screened, promised + more, NUM_TRUER)


def _key(fit: Fit) -> Hypothesis:
    return frozenset(fit.problem.effects), fit.problem.segments.key
