"""From an explanation to a verdict: which additions matter on held-out recordings, and which are certain."""

from dataclasses import dataclass, replace

import numpy as np

from det2stoc_bayes.mismatch.classes import Class, classes
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, effective_share
from det2stoc_bayes.mismatch.explain import Explanation
from det2stoc_bayes.mismatch.finding import SURE, RecordingPart
from det2stoc_bayes.mismatch.heldout import HeldOut, held_out
from det2stoc_bayes.mismatch.horizon import extend
from det2stoc_bayes.mismatch.numerics import Numerics, by_steps, converging, corrected, held_error
from det2stoc_bayes.mismatch.refit import refit, swap, without
from det2stoc_bayes.mismatch.shares import (
    NEGLIGIBLE,
    excess_beyond_chance,
    share_explained,
    shares_by_recording,
)
from det2stoc_bayes.optimize import Fit

SPOILT = 0.05  # of a column's held-out error: more of it where other columns gain is no chance


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that matters: its class, the other classes of its place, and its share of the held-out error."""

    placed: PlacedEffect
    chosen: Class
    rest: tuple[Class, ...]
    bare: HeldOut | None  # scores without it; None: no simulation follows the recordings without it
    explains: float = 1.0
    by_recording: tuple[RecordingPart, ...] = ()

    def scored(self, believed: HeldOut, whole: HeldOut) -> "Named":
        """With its shares of the believed model's error."""
        if self.bare is None:
            return self
        share, each = share_explained(believed, self.bare, whole), shares_by_recording(believed, self.bare, whole)
        return replace(self, explains=share, by_recording=each)


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
    share: float  # independent samples per sample, of the fit that is told
    undecided: tuple[Named, ...] = ()  # what was found beside the effects named, and cannot be told

    def rescored(self, held_before: HeldOut, held_after: HeldOut) -> "Judgement":
        """The same with held-out scores that are more exact, and shares by them where nothing else was scored."""
        named = [
            replace(n, bare=held_before).scored(held_before, held_after) if n.bare is self.held_before else n
            for n in self.named
        ]
        return replace(self, held_before=held_before, held_after=held_after, named=tuple(named))

    @property
    def shown(self) -> Fit:
        """The fit that the corrected simulator takes: nothing is added that could not be named."""
        return self.after if self.verdict == "mismatch" else self.before


def judge(before: Fit, found: Explanation, numerics: Numerics | None) -> Judgement:
    """The simplest member of each class stands for it; effects that explain next to nothing are set apart.

    Places are judged over the stretches of the search, where rivals were fitted alike; what is told of the best
    explanation, its parameters and its errors, is told at the longest horizon that it serves.
    """
    places = tuple(classes(slot, found.num_candidates, found.share) for slot in found.slots)
    after = found.after
    for i, placed in enumerate(after.problem.effects):
        after = swap(after, i, _class_of(places[i], placed).members[0])
    if after.problem.effects:
        before, after, numerics = _as_far_as_it_goes(before, corrected(after), numerics)
    elif numerics is not None:
        after, numerics = converging(after, numerics)
    pair = before, after

    def scored(fit: Fit) -> HeldOut:
        return held_out(fit, *pair)

    held_before = scored(before)
    told_share = found.share if after is found.after else effective_share(after)
    whole = scored(after) if after.problem.effects else held_before
    share = 0.0
    if numerics is not None:
        fine: Fit | None = numerics.fit
        if before.problem.segments.extent != fine.problem.segments.extent:  # shorter stretches hide what is missing
            fine = refit(after, ())
        finer = held_before if fine is None else scored(fine)
        share = share_explained(held_before, held_before, finer)
        gone = held_before.chi2.sum() - finer.chi2.sum()
        little = gone < NEGLIGIBLE * held_before.num_values.sum()  # beside noise: every step errs a little
        if share < NEGLIGIBLE or little:
            numerics, after = None, held_error(after)
            whole = scored(after)
    plain = held_before
    if after.problem.effects and after.problem.finer is not None:  # what its steps err is no merit of an effect
        alone = refit(after, ())
        plain = plain if alone is None else scored(alone)

    def bare(fit: Fit, i: int) -> HeldOut | None:
        """Scores without effect i; without a single one the believed model stands."""
        if len(fit.problem.effects) == 1 and numerics is None:
            return plain
        lean = _lean(found, fit, i)
        return None if lean is None else scored(lean)

    named, negligible = [], []
    for i, placed in enumerate(after.problem.effects):
        chosen = _class_of(places[i], placed)
        rest = tuple(c for c in places[i] if c is not chosen)
        one = Named(placed, chosen, rest, bare(after, i)).scored(held_before, whole)
        if one.explains < NEGLIGIBLE and not _beyond_noise(after, one.explains, held_before):
            negligible.append((placed, one.explains))
        else:
            named.append(one)
    if named and numerics is None:
        together = share_explained(held_before, plain, whole)
        if together < NEGLIGIBLE and not _beyond_noise(after, together, held_before):  # each needs the other in vain
            negligible, named = [*negligible, *((n.placed, together) for n in named)], []
    for placed, _ in negligible:
        after = _lean(found, after, list(after.problem.effects).index(placed)) or after
    if negligible and named:  # what the others explain is told beside those that stay
        whole = scored(after)
        kept = list(after.problem.effects)
        named = [replace(n, bare=bare(after, kept.index(n.placed))).scored(held_before, whole) for n in named]
    if not named and numerics is None:
        verdict = "no_mismatch"
        held = after.problem.finer is not None and not after.problem.effects
        if held and scored(after).chi2.sum() <= held_before.chi2.sum():  # psi would make up for the error it holds
            before = after
        after, held_before = before, held_out(before)
    else:
        verdict = "mismatch" if all(n.chosen.probability >= SURE for n in named) else "inconclusive"
    held_after = held_before if after is before else whole if named else scored(after)
    if named and _spoils(after, held_before, held_after):
        verdict = "inconclusive"
    return Judgement(
        verdict=verdict,
        before=before,
        after=after,
        found=found,
        places=places,
        named=tuple(named),
        negligible=tuple(negligible),
        numerics=numerics,
        numerics_share=share,
        held_before=held_before,
        held_after=held_after,
        share=told_share,
    )


def _as_far_as_it_goes(before: Fit, after: Fit, numerics: Numerics | None) -> tuple[Fit, Fit, Numerics | None]:
    """An explanation at the longest horizon that it serves, and the believed model there; as they are if it fails.

    Steps that converged for the believed model need not for what is told; where they are no finding, their error is
    held.
    """
    longer = extend(after, far=True)
    bare = None if longer is after else refit(longer, ())
    if bare is not None:
        before = bare if bare.problem.timestep is None else by_steps(bare, None, None) or bare
        after = corrected(longer)
    after, numerics = converging(after, numerics)
    return before, held_error(after) if numerics is None else after, numerics


def _spoils(after: Fit, before: HeldOut, later: HeldOut) -> bool:
    """Whether a misfit stays and some column is told worse than without: what is missing is not what was found."""
    with np.errstate(invalid="ignore"):
        return after.noise_inflation >= MODEL_ERROR and bool((later.rmse > (1 + SPOILT) * before.rmse).any())


def _beyond_noise(after: Fit, explains: float, believed: HeldOut) -> bool:
    """Whether an effect changes recordings by more than their noise, in a model that explains them."""
    change = explains * excess_beyond_chance(believed)
    return after.noise_inflation < MODEL_ERROR and change > believed.num_values.sum()


def _class_of(place: list[Class], placed: PlacedEffect) -> Class:
    return next(c for c in place if any(r.placed == placed for r in c.alike))


def _lean(found: Explanation, after: Fit, i: int) -> Fit | None:
    """The best fit without effect i, where there is one; that of the explanation where it still stands."""
    if after is not found.after:
        return without(after, i)
    base = found.slots[i].base
    return None if after.problem.effects[i] in base.problem.effects else base
