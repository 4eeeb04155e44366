"""Several effects of which one cannot be told: the others are named if they are the same with it and without it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.crossed import misses
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import effective_share, widened
from det2stoc_bayes.mismatch.explain import Explanation, judged
from det2stoc_bayes.mismatch.finding import SURE
from det2stoc_bayes.mismatch.judgement import Judgement
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.refit import keep, refit

APART = 2.0  # sds by which what is told may be another beside the effect that is not


def without_undecided(
    said: Judgement, judge_anew: Callable[[Explanation], Judgement], pool: Sequence[PlacedEffect], looks: Looks
) -> Judgement:
    """The judgement of the effects that are sure, where one beside them is not; as it is where that says anything else.

    They are judged anew without it, for beside it alone they may have been sure. Where they, or psi, take up what it
    did, their sizes are not known.
    """
    unsure = tuple(n for n in said.named if n.chosen.probability < SURE)
    sure = [n for n in said.named if n not in unsure]
    if said.verdict != "inconclusive" or len(unsure) != 1 or not sure:
        return said
    full = said.found.after
    stays = [any(n.chosen is c for n in sure for c in place) for place in said.places]
    kept = [e for e, stay in zip(full.problem.effects, stays, strict=True) if stay]
    fewer = refit(full, kept)
    if fewer is None or not unmoved(fewer.point.z, widened(fewer, effective_share(fewer)), keep(full, kept).z):
        return said
    whole = list(dict.fromkeys([*pool, *(r.placed for slot in said.found.slots for r in slot.ranked)]))
    after, slots = judged(fewer, {kept[0]: said.found.before} if len(kept) == 1 else {}, whole, looks)
    others = looks.others_chose or misses(after)
    found = replace(said.found, after=after, slots=slots, share=effective_share(after), others_chose=others)
    alone = judge_anew(found)
    if alone.verdict != "mismatch" or set(after.problem.effects) != set(kept):
        return said
    return replace(alone, undecided=unsure, negligible=(*said.negligible, *alone.negligible))


def unmoved(
    z: Float[np.ndarray, " size"], covariance: Float[np.ndarray, "size size"], other: Float[np.ndarray, " size"]
) -> bool:
    """Whether unknowns that are told hold other values of them within APART sds, each of them."""
    return bool((np.abs(z - other) <= APART * np.sqrt(np.diag(covariance))).all())
