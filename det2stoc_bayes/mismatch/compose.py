"""A judgement in words and numbers: the content of diagnosis.json."""

from collections.abc import Mapping
from importlib.metadata import version

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.errors import listing
from det2stoc_bayes.mismatch import finding
from det2stoc_bayes.mismatch.conflict import tail_probability
from det2stoc_bayes.mismatch.credence import Credence
from det2stoc_bayes.mismatch.effects import CATALOGUE, PlacedEffect
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, log_evidence, probabilities
from det2stoc_bayes.mismatch.experiment import propose
from det2stoc_bayes.mismatch.judgement import Judgement, Named
from det2stoc_bayes.mismatch.mirrors import mirrored
from det2stoc_bayes.mismatch.other_psi import other_psi, others_beyond, over_equivalents
from det2stoc_bayes.mismatch.race import Ranked
from det2stoc_bayes.mismatch.refit import posed_alike, swap
from det2stoc_bayes.mismatch.shares import NEGLIGIBLE, by_element, excess_beyond_chance
from det2stoc_bayes.mismatch.statements import (
    alternatives,
    draws,
    drop,
    element,
    finer_step,
    likeliest,
    mirror,
    open_beside,
    parameters,
    psi_moments,
    spanning,
    statement,
)
from det2stoc_bayes.mismatch.where import Condition
from det2stoc_bayes.optimize import Fit

UNLIKELY = 0.01  # tail probability under its prior at which a psi is said to lie far out
LISTED = 4  # recordings by name in the summary
PACKAGES = ("det2stoc-bayes", "mujoco", "numpy", "scipy")


class Composer:
    """Builds the finding of one judgement from posterior draws before and after."""

    def __init__(self, judged: Judgement, credence: Credence, when: list[Condition], seed: int):
        self.judged, self.credence, self.when, self.seed = judged, credence, when, seed
        self.share = judged.share
        self.study = judged.before.problem.simulator.study

    def compose(self, seconds: float) -> finding.Finding:
        """The whole content of diagnosis.json."""
        judged = self.judged
        effects = tuple(self._effect(n) for n in judged.named)
        if judged.numerics is not None:
            effects = (self._numerical(), *effects)
        candidates, experiment = self._open_question()
        named = effects if judged.verdict == "mismatch" else ()
        supports = {p.name: p.prior.support for p in self.study.parameters}
        fit, psi = self._scores(), over_equivalents(self._psi(), named, supports)
        return finding.Finding.model_validate(
            {
                "verdict": judged.verdict,
                "summary": self._summary(named, candidates, fit, psi),
                "evidence": {"log10_bayes_factor": self._bayes_factor(), "noise_inflation": self._inflation()},
                "where": {
                    "elements": by_element(named),
                    "when": [{"condition": c.text, "share": c.share} for c in self.when],
                },
                "effects": named,
                "candidates": candidates,
                "experiment": experiment,
                "fit": fit,
                "psi": psi,
                "seconds": seconds,
                "versions": {name: version(name) for name in PACKAGES},
                "seed": self.seed,
                **self.credence.summary(),
                "negligible": [
                    {"name": p.effect.name, "element": element(p).model_dump(), "explains": s}
                    for p, s in judged.negligible
                ],
            }
        )

    def _effect(self, named: Named) -> finding.Effect:
        first, *others = named.chosen.members
        listed, psi = {}, {}
        place = list(self.judged.after.problem.effects).index(named.placed)
        for m in (first, *others):
            fit, z = self._drawn(m, place)
            listed[m.placed], psi[m.placed] = parameters(fit, m.placed, z), psi_moments(fit, z)
        turned = self._mirrored(first.placed, listed[first.placed])
        listed[first.placed] = spanning(listed[first.placed], turned)
        equally = tuple(f"{m.placed.effect.name.replace('_', ' ')} on {m.placed.element.label}" for m in others)
        return finding.Effect(
            name=first.placed.effect.name,
            element=element(first.placed),
            law=first.placed.effect.law_text,
            statement=statement(first.placed, listed[first.placed], equally),
            probability=min(named.chosen.probability, 1.0),
            explains=named.explains,
            recordings="all",
            parameters=listed[first.placed],
            equivalent=tuple(
                finding.Equivalent(
                    name=m.placed.effect.name,
                    element=element(m.placed),
                    parameters=listed[m.placed],
                    psi=others_beyond(psi[m.placed], psi[first.placed]),
                )
                for m in others
            ),
            alternatives=tuple(alternatives(named.rest)),
            by_recording=named.by_recording,
            mirrored=turned,
        )

    def _mirrored(
        self, placed: PlacedEffect, told: Mapping[str, finding.Parameter]
    ) -> tuple[dict[str, finding.Quantity], ...]:
        """Those of the effect's parameters that are others at each other top of its posterior."""
        belief = self.credence.after
        twins = mirrored(belief, placed) if placed in belief.fit.problem.effects else []
        tops = [parameters(belief.fit, placed, twin) for twin in twins]
        return tuple({n: q for n, q in t.items() if isinstance(q, finding.Quantity) and q != told[n]} for t in tops)

    def _drawn(self, member: Ranked, place: int) -> tuple[Fit, Float[np.ndarray, "draws size"]]:
        """A member's posterior as what is told has it: the belief's own, or draws about its fit there."""
        judged, belief = self.judged, self.credence.after
        if member.placed in judged.after.problem.effects:
            return belief.fit, belief.z
        fit = member.fit
        if not posed_alike(fit, judged.after):
            longer = swap(judged.after, place, member)
            fit = longer if member.placed in longer.problem.effects else fit
        return fit, draws(fit, judged.share, self.seed)

    def _numerical(self) -> finding.Effect:
        numerics = self.judged.numerics
        assert numerics is not None
        step = numerics.timestep
        better = "tells what looks like recordings of such a simulation" if numerics.simulated else "converges"
        return finding.Effect(
            name="numerical_integration",
            element=finding.Element(kind="simulator", name="option"),
            law=CATALOGUE["numerical_integration"].law_text,
            statement=f"The believed integration is too coarse: {numerics.integrator} at {step:g} s {better}.",
            probability=float(probabilities([numerics.gain], self.judged.found.num_candidates)[0]),
            explains=self.judged.numerics_share,
            recordings="all",
            equivalent=(),
            alternatives=(),
            parameters={
                "timestep": finding.Quantity(mean=step, sd=0.0, interval=(step, step), unit="s"),
                "integrator": numerics.integrator,
            },
        )

    def _open_question(self) -> tuple[list[finding.Alternative], finding.Experiment | None]:
        """What cannot be told apart, and the recording that would."""
        judged = self.judged
        unsure = judged.named if judged.verdict == "inconclusive" else judged.undecided
        if not unsure:
            return [], None
        doubtful = min(unsure, key=lambda n: n.chosen.probability)
        every = sorted((doubtful.chosen, *doubtful.rest), key=lambda c: -c.probability)
        p = propose(every[0].members[0].fit, every[min(1, len(every) - 1)].members[0].fit)
        experiment = {
            "text": p.text,
            "input": p.input,
            "initial_state": p.initial_state,
            "expected_gain": p.expected_gain,
        }
        return alternatives(every, 8), finding.Experiment.model_validate(experiment)

    def _bayes_factor(self) -> float:
        judged = self.judged
        gains = [place[0].members[0].gain for place in judged.places if place]
        if judged.after is not judged.before:
            gains.append(log_evidence(judged.after, self.share) - log_evidence(judged.before, self.share))
        return max(gains, default=0.0) / np.log(10)

    def _inflation(self) -> float | None:
        given = all(c in self.study.noise for c in self.judged.before.problem.segments.columns)
        return self.judged.before.noise_inflation if given else None

    def _scores(self) -> finding.Fit:
        before, after = self.judged.held_before, self.judged.held_after
        problem, gain = self.judged.before.problem, after.log_density - before.log_density
        columns, samples = problem.segments.columns, before.samples
        excess = excess_beyond_chance(before)
        left = max(after.chi2.sum() - after.num_values.sum(), 0.0) / excess if excess else 0.0
        records = self.study.holdout or self.study.recordings
        spans = [r.time[min(samples or len(r.time), len(r.time)) - 1] - r.time[0] for r in records]
        return finding.Fit(
            horizon_s=float(np.median(spans)),
            heldout_log_density_before=float(before.log_density.sum()),
            heldout_log_density_after=float(after.log_density.sum()),
            difference=float(gain.sum()),
            standard_error=float(np.std(gain, ddof=1) * np.sqrt(len(gain))) if len(gain) > 1 else None,
            rollout_rmse_before=dict(zip(columns, before.rmse.tolist(), strict=True)),
            rollout_rmse_after=dict(zip(columns, after.rmse.tolist(), strict=True)),
            rollout_rmse_noise=dict(zip(columns, problem.noise.tolist(), strict=True)),
            unexplained_share=float(min(left, 1.0)),
            heldout_chose=self.judged.found.others_chose and bool(self.study.holdout),
        )

    def _psi(self) -> dict[str, finding.PsiChange]:
        judged, out = self.judged, {}
        before, after = (psi_moments(b.fit, b.z) for b in (self.credence.before, self.credence.after))
        for j, p in enumerate(self.study.parameters):
            tail = tail_probability(p, float(judged.after.problem.psi(judged.after.point.z)[j]))
            out[p.name] = finding.PsiChange(before=before[p.name], after=after[p.name], prior_conflict=tail)
        return out

    def _summary(self, effects, candidates, fit: finding.Fit, psi: dict[str, finding.PsiChange]) -> str:
        if self.judged.verdict == "no_mismatch":
            return self._all_well(psi)
        if self.judged.verdict == "inconclusive":
            each = likeliest(candidates)
            if candidates and candidates[0].probability >= finding.SURE:
                gone = drop(fit, "the best that was found")
                return f"Something was left out, and nothing found accounts for it; nearest is {each[0]}. {gone}"
            return f"Something was left out, but the recordings do not tell what: {', '.join(each)}."
        gone = drop(fit, "it" if len(effects) == 1 else "them")
        step, left = finer_step(self.judged.shown.problem), self.credence.predictive.text()
        told = [t for e in effects for t in (e.statement, mirror(e), _untold(e, alone=len(effects) == 1), other_psi(e))]
        return " ".join(text for text in [*told, gone, open_beside(candidates), step, left] if text)

    def _all_well(self, psi: dict[str, finding.PsiChange]) -> str:
        count = self.judged.found.num_candidates
        text = f"Nothing in the catalogue ({count} candidates) explains the recordings better than the model."
        inflation, told = self._inflation(), self.credence.predictive
        if inflation is not None and inflation > MODEL_ERROR and not told.glitches:
            text += f" But they stay unexplained: the error's variance is {inflation:.3g} times the noise's."
        elif told.fails:
            text += f" But: {told.text()}"
        odd = [n for n, p in psi.items() if isinstance(p.prior_conflict, float) and p.prior_conflict < UNLIKELY]
        if odd:
            text += f" But {', '.join(odd)} lies far out in its prior: the believed value or its prior is wrong."
        if self.judged.negligible:
            names = ", ".join(p.label.replace("_", " ") for p, _ in self.judged.negligible)
            text += f" Significant but negligible (under {NEGLIGIBLE:.0%} of the error): {names}."
        return f"{text} {finer_step(self.judged.shown.problem)}".strip()


def _untold(effect: finding.Effect, alone: bool) -> str:
    """In which recordings an effect does not show, or is not sure; empty where there is none."""
    of = {kind: [p.recording for p in effect.by_recording if p.kind == kind] for kind in ("negligible", "uncertain")}
    parts = [f"{kind} in {listing(names, LISTED)}" for kind, names in of.items() if names]
    if not parts:
        return ""
    subject = "It" if alone else effect.name.replace("_", " ").capitalize()
    return f"{subject} is {' and '.join(parts)}."
