"""How far a judgement can be believed: posteriors, leave-one-out scores, stacking, predictive check, exact chains."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.belief import Belief, Sampler, Temper, affordable, believe, roughly, with_chains
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR
from det2stoc_bayes.mismatch.heldout import HeldOut, held_out
from det2stoc_bayes.mismatch.judgement import Judgement
from det2stoc_bayes.mismatch.leave_out import checked
from det2stoc_bayes.mismatch.predictive import PredictiveCheck, check
from det2stoc_bayes.mismatch.refit import swap
from det2stoc_bayes.mismatch.whiteness import whiteness
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.psis import r_hats, stacking_weights, standard_errors

MOST_ERRORS = 3.0  # Monte-Carlo standard errors by which means of the cheap and the exact way may differ
SD_RATIO = (0.85, 1.18)
SERIOUS = 1e-6  # probability of a rival below which no weight of it is asked for
MIXED = 1.05  # R-hat of chains that agree with each other
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Credence:
    """What the claim of a diagnosis rests on."""

    before: Belief
    after: Belief
    predictive: PredictiveCheck  # of the corrected simulator
    white_before: float  # p-value of white residuals under the believed model
    leave_one_out: dict[str, Any] | None
    stacking: dict[str, float] | None
    exact: tuple[dict[str, Any], ...]

    def summary(self) -> dict[str, Any]:
        """For diagnosis.json."""
        return {
            "belief": {"before": self.before.summary(), "after": self.after.summary()},
            "predictive_check": self.predictive.summary() | {"whiteness_before": self.white_before},
            "leave_one_out": self.leave_one_out,
            "stacking": self.stacking,
            "exact": self.exact or None,
        }


def weigh(
    judged: Judgement,
    seed: int,
    *,
    temper: Temper | None = None,
    sampler: Sampler | None = None,
    progress: Progress = lambda *_: None,
) -> tuple[Judgement, Credence]:
    """The judgement with its leave-one-out scores checked, and how far it can be believed."""
    rivals, share = _rivals(judged), judged.share
    fits = {"before": judged.before, "after": judged.after} | rivals
    beliefs: dict[str, Belief] = {}
    for i, (name, fit) in enumerate(fits.items()):
        progress("weighing draws by the exact likelihood", i, len(fits))
        same = name == "after" and judged.after is judged.before
        # A rival's draws serve the comparison with chains alone.
        if name in ("before", "after") or sampler is not None:
            beliefs[name] = beliefs["before"] if same else _believed(fit, share, seed, temper)
    progress("weighing draws by the exact likelihood", len(fits), len(fits))
    compared = []
    if sampler is not None:
        for name in (n for n in fits if n != "before"):
            beliefs[name], one = _by_chains(name, beliefs[name], seed, sampler, progress)
            compared.append(one)
        if judged.after is judged.before:
            beliefs["before"] = beliefs["after"]
    held_before, k_before, again_before = checked(judged.before, judged.held_before, beliefs["before"])
    held_after, k_after, again_after = held_before, k_before, again_before
    if judged.after is not judged.before:
        held_after, k_after, again_after = checked(judged.after, judged.held_after, beliefs["after"])
    loo = {
        "k_hat": {"before": k_before, "after": k_after},
        "refitted": {"before": again_before, "after": again_after},
    }
    credence = Credence(
        before=beliefs["before"],
        after=beliefs["after"],
        predictive=check(judged.shown, seed),
        white_before=whiteness(judged.before).p_value,
        leave_one_out=loo if k_before or k_after else None,
        stacking=_stacking(judged, held_before, held_after, rivals),
        exact=tuple(compared),
    )
    return judged.rescored(held_before, held_after), credence


def _believed(fit: Fit, share: float, seed: int, temper: Temper | None) -> Belief:
    """Draws that the exact likelihood weighs, unless a misfit remains."""
    if fit.noise_inflation >= MODEL_ERROR:
        return roughly(fit, share, seed)
    return believe(fit, share, seed, temper=temper if affordable(fit) else None)


def _rivals(judged: Judgement) -> dict[str, Fit]:
    """The best other class of each place that may be true, by the label of the effect that stands there."""
    out = {}
    for named in judged.named:
        best = max(named.rest, key=lambda c: c.probability, default=None)
        if best is not None and best.probability > SERIOUS:
            other = best.members[0]
            i = list(judged.after.problem.effects).index(named.placed)
            out[f"{other.placed.label} instead of {named.placed.label}"] = swap(judged.after, i, other)
    return out


def _stacking(judged: Judgement, before: HeldOut, after: HeldOut, rivals: dict[str, Fit]) -> dict[str, float] | None:
    """Weights by predictive densities of left-out recordings; None for a single recording or nothing to choose from."""
    if judged.after is judged.before or len(before.names) < 2:
        return None
    densities = {"before": before.log_density, "after": after.log_density}
    if rivals:
        scores = {name: held_out(fit, judged.before, judged.after).log_density for name, fit in rivals.items()}
        best = max(scores, key=lambda name: scores[name].sum())
        densities[best] = scores[best]
    weights = stacking_weights(np.stack(list(densities.values()), 1))
    return dict(zip(densities, weights.tolist(), strict=True))


def _by_chains(
    name: str, cheap: Belief, seed: int, sampler: Sampler, progress: Progress
) -> tuple[Belief, dict[str, Any]]:
    """A posterior by Markov chains, and how it compares."""
    if cheap.density.size == 0:
        return cheap, {"hypothesis": name, "agree": True, "unknowns": {}}
    counter = cheap.density.problem.simulator.counter
    simulations = counter.simulations
    chains = sampler(cheap.density, seed, lambda done, total: progress(f"sampling {name} by NUTS", done, total))
    evaluations = (counter.simulations - simulations) // cheap.density.problem.segments.count
    return with_chains(cheap, chains, evaluations), compared(name, cheap, chains)


def compared(name: str, cheap: Belief, chains: Float[np.ndarray, "chain draw size"]) -> dict[str, Any]:
    """Differences of means in Monte-Carlo standard errors and ratios of sds, cheap to exact, by unknown."""
    own = cheap.z.std(0) / np.sqrt(len(cheap.z))
    errors = np.hypot(standard_errors(chains), own)
    means = (cheap.z.mean(0) - chains.mean((0, 1))) / errors
    ratios = cheap.z.std(0) / chains.std((0, 1))
    agree = (np.abs(means) < MOST_ERRORS) & (ratios > SD_RATIO[0]) & (ratios < SD_RATIO[1])
    unknowns = zip(cheap.density.problem.names, means.tolist(), ratios.tolist(), strict=True)
    r_hat = float(r_hats(chains).max())
    return {
        "hypothesis": name,
        "agree": bool(agree.all()) if r_hat < MIXED else None,  # chains that did not mix show nothing
        "r_hat": r_hat,
        "unknowns": {n: {"mean_difference": m, "sd_ratio": r} for n, m, r in unknowns},
    }
