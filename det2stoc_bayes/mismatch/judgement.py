"""From an explanation to a verdict: which additions matter on held-out recordings, and which are certain."""

from dataclasses import dataclass, replace

from det2stoc_bayes.mismatch.classes import Class, classes
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR
from det2stoc_bayes.mismatch.explain import Explanation
from det2stoc_bayes.mismatch.finding import SURE
from det2stoc_bayes.mismatch.heldout import NEGLIGIBLE, HeldOut, excess_beyond_chance, held_out, share_explained
from det2stoc_bayes.mismatch.numerics import Numerics, corrected
from det2stoc_bayes.mismatch.refit import swap, without
from det2stoc_bayes.optimize import Fit, fit_many


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that matters: its class, its share of the held-out error, and the other classes of its place."""

    placed: PlacedEffect
    chosen: Class
    explains: float
    rest: tuple[Class, ...]


@dataclass(frozen=True, eq=False)
class Judgement:
    """The verdict and everything that it rests on."""

    verdict: str
    before: Fit
    after: Fit
    found: Explanation
    places: tuple[list[Class], ...]
    named: tuple[Named, ...]
    negligible: tuple[tuple[PlacedEffect, float], ...]
    numerics: Numerics | None  # None unless it matters
    numerics_share: float
    held_before: HeldOut
    held_after: HeldOut

    @property
    def shown(self) -> Fit:
        """The fit that the corrected simulator takes: nothing is added that could not be named."""
        return self.after if self.verdict == "mismatch" else self.before


def judge(before: Fit, found: Explanation, numerics: Numerics | None) -> Judgement:
    """The simplest member of each class stands for it; effects that explain next to nothing are set apart."""
    held_before = held_out(before)
    places = tuple(classes(slot, found.num_candidates, found.share) for slot in found.slots)
    after = found.after
    for i, placed in enumerate(after.problem.effects):
        after = swap(after, i, _class_of(places[i], placed).members[0])
    after = corrected(after) if after.problem.effects else after
    whole = held_out(after) if after.problem.effects else held_before
    share = 0.0
    if numerics is not None:
        share = share_explained(held_before, held_before, held_out(numerics.fit))
        if share < NEGLIGIBLE:
            numerics, after = None, corrected(_at_believed_step(after))
            whole = held_out(after)
    named, negligible = [], []
    for i, placed in enumerate(after.problem.effects):
        explains = _explained(found, after, i, held_before, whole, numerics is None)
        if explains < NEGLIGIBLE and not _beyond_noise(after, explains, held_before):
            negligible.append((placed, explains))
        else:
            chosen = _class_of(places[i], placed)
            named.append(Named(placed, chosen, explains, tuple(c for c in places[i] if c is not chosen)))
    for placed, _ in negligible:
        after = _lean(found, after, list(after.problem.effects).index(placed))
    if negligible and named:  # what the others explain is told beside those that stay
        whole = held_out(after)
        kept = list(after.problem.effects)
        shares = [_explained(found, after, kept.index(n.placed), held_before, whole, numerics is None) for n in named]
        named = [replace(n, explains=s) for n, s in zip(named, shares, strict=True)]
    if not named and numerics is None:
        verdict, after = "no_mismatch", before
    else:
        verdict = "mismatch" if all(n.chosen.probability >= SURE for n in named) else "inconclusive"
    held_after = held_before if after is before else whole if named else held_out(after)
    return Judgement(
        verdict, before, after, found, places, tuple(named), tuple(negligible), numerics, share, held_before, held_after
    )


def _beyond_noise(after: Fit, explains: float, believed: HeldOut) -> bool:
    """Whether an effect changes recordings by more than their noise, in a model that explains them."""
    change = explains * excess_beyond_chance(believed)
    return after.noise_inflation < MODEL_ERROR and change > believed.num_values.sum()


def _at_believed_step(fit: Fit) -> Fit:
    """The same effects under the believed integration."""
    problem = replace(fit.problem, timestep=None, integrator=None)
    return fit_many([(problem, fit.point)], tolerance=0.3)[0] or fit


def _class_of(place: list[Class], placed: PlacedEffect) -> Class:
    return next(c for c in place if any(r.placed == placed for r in c.alike))


def _lean(found: Explanation, after: Fit, i: int) -> Fit:
    """The best fit without effect i; that of the explanation where it still stands."""
    return found.slots[i].base if after is found.after else without(after, i)


def _explained(
    found: Explanation, after: Fit, i: int, believed: HeldOut, whole: HeldOut, at_believed_step: bool
) -> float:
    """Share of the held-out error that goes with effect i; without a single one the believed model stands."""
    alone = len(after.problem.effects) == 1 and at_believed_step
    return share_explained(believed, believed if alone else held_out(_lean(found, after, i)), whole)
