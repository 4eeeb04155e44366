"""Several effects of which some are sure and some are not: the sure ones are named, the rest stays unexplained."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from det2stoc_bayes.mismatch.crossed import misses
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import effective_share
from det2stoc_bayes.mismatch.explain import Explanation, judged
from det2stoc_bayes.mismatch.finding import SURE
from det2stoc_bayes.mismatch.judgement import Judgement
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.refit import refit


def without_undecided(
    said: Judgement, again: Callable[[Explanation], Judgement], pool: Sequence[PlacedEffect], looks: Looks
) -> Judgement:
    """The judgement of the effects that are sure, where others beside them are not; as it is where that names none.

    They are judged `again` without the others: beside these alone they may have been sure.
    """
    unsure = tuple(n for n in said.named if n.chosen.probability < SURE)
    if said.verdict != "inconclusive" or not unsure or len(unsure) == len(said.named):
        return said
    found = said.found
    sure = [not any(n.chosen is c for n in unsure for c in place) for place in said.places]
    kept = [e for e, stays in zip(found.after.problem.effects, sure, strict=True) if stays]
    fewer = refit(found.after, kept)
    if fewer is None:
        return said
    whole = list(dict.fromkeys([*pool, *(r.placed for slot in found.slots for r in slot.ranked)]))
    after, slots = judged(fewer, {}, whole, looks)
    others = looks.others_chose or misses(after)
    rest = again(replace(found, after=after, slots=slots, share=effective_share(after), others_chose=others))
    return replace(rest, undecided=unsure) if rest.verdict == "mismatch" else said
