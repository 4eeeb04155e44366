"""What could stand in an effect's place, fitted and told on equal terms."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from det2stoc_bayes.mismatch.crossed import misses, untold
from det2stoc_bayes.mismatch.evidence import by_chance, effective_share, log_evidence
from det2stoc_bayes.mismatch.kin import with_kin
from det2stoc_bayes.mismatch.numerics import comparable
from det2stoc_bayes.mismatch.race import Ranked, Slot, gain, settled
from det2stoc_bayes.mismatch.shares import NEGLIGIBLE

PROMISED = 0.8  # of what an effect promised, that a likely rival did
AHEAD = 5.0  # nats by which an effect may be ahead of a rival without further question


def with_rivals(slot: Slot, own: Ranked) -> Slot:
    """What could stand in an effect's place, those that predict the same fitted from where it ended."""
    slot, own = _arrived(with_kin(slot, own), own)
    ranked = _rivals(own, slot.ranked)
    fits = comparable([r.fit for r in ranked])
    if all(f is r.fit for r, f in zip(ranked, fits, strict=True)):
        return replace(slot, ranked=ranked)
    share = effective_share(max(fits, key=log_evidence))
    told = [Ranked(r.placed, f, gain(slot.base, f, share)) for r, f in zip(ranked, fits, strict=True)]
    return replace(slot, ranked=tuple(sorted(told, key=lambda r: -r.gain)))


def _arrived(slot: Slot, own: Ranked) -> tuple[Slot, Ranked]:
    """Beside an effect at its optimum the likely rivals that were on their way go further.

    On its way there one has less evidence than what it would predict the same as, and would be another name for it.
    """
    if own.fit.end == "unfinished":
        return slot, own
    share, first, likely = effective_share(own.fit), len(slot.base.problem.effects), _likely(slot, own)
    slow = [r.fit for r in slot.ranked if r.placed != own.placed and r.fit.end == "unfinished" and likely(r)]
    found = settled(slow, share, first, least=1.0)
    if all(f is g for f, g in zip(found, slow, strict=True)):
        return slot, own
    fits = {r.placed: r.fit for r in slot.ranked} | {f.problem.effects[-1]: f for f in found}
    ranked = [Ranked(placed, f, gain(slot.base, f, share)) for placed, f in fits.items()]
    return replace(slot, ranked=tuple(ranked)), replace(own, gain=gain(slot.base, own.fit, share))


def _likely(slot: Slot, own: Ranked) -> Callable[[Ranked], bool]:
    """Of rivals: while a misfit remains, whether they tell other recordings about as well.

    Where the effect leaves but chance, whether they promised about as much as it did.
    """
    if misses(own.fit):
        score = (1 + NEGLIGIBLE) * untold(own.fit)
        return lambda r: untold(r.fit) < score
    promised = {s.placed: s.log_evidence for s in slot.screened}
    least = PROMISED * promised.get(own.placed, 0.0)
    return lambda r: by_chance(own.fit) and promised.get(r.placed, 0.0) > least > 0


def _rivals(own: Ranked, ranked: Sequence[Ranked]) -> tuple[Ranked, ...]:
    """An effect and what could stand in its place, most evidence first.

    While a misfit remains, what has about as much evidence or more must tell other recordings about as well.
    """
    rest = [r for r in ranked if r.placed != own.placed]
    if misses(own.fit):
        score = (1 + NEGLIGIBLE) * untold(own.fit)
        rest = [r for r in rest if r.gain < own.gain - AHEAD or untold(r.fit) < score]
    return tuple(sorted([own, *rest], key=lambda r: -r.gain))
