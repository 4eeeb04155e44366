"""A verdict on a study with contact as the content of diagnosis.json, and as arrays."""

from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.free_flight import falls
from det2stoc_bayes.mismatch import finding, result
from det2stoc_bayes.mismatch.compose import PACKAGES, UNLIKELY
from det2stoc_bayes.mismatch.conflict import tail_probability
from det2stoc_bayes.mismatch.contact.experiment import proposed
from det2stoc_bayes.mismatch.contact.judge import Class, Verdict, corrected, covariance, log10_bayes, worst_column
from det2stoc_bayes.mismatch.contact.pair import Pair
from det2stoc_bayes.mismatch.contact.places import shares
from det2stoc_bayes.mismatch.contact.rollouts import rollouts
from det2stoc_bayes.mismatch.replay import replay
from det2stoc_bayes.mismatch.shares import NEGLIGIBLE, by_element
from det2stoc_bayes.mismatch.statements import (
    drop,
    element,
    likeliest,
    open_beside,
    parameters,
    psi_moments,
    statement,
    variables,
)
from det2stoc_bayes.mismatch.where import Condition

NUM_DRAWS = 1000
LARGE = 1.5  # times what the model itself would leave: an error that is told


class ContactComposer:
    """Builds the finding and the arrays of one verdict."""

    def __init__(self, said: Verdict, when: list[Condition], seed: int):
        self.said, self.when, self.seed = said, when, seed
        self.study = said.before.fit.problem.simulator.study
        pairs = {"before": said.before, "after": said.shown}
        self.draws = {k: self._draws(p) for k, p in pairs.items()}
        self.runs = {k: {"fit": rollouts(p.fit), "held": rollouts(p.held)} for k, p in pairs.items()}

    def _draws(self, pair: Pair) -> Float[np.ndarray, "draws size"]:
        """Of the unknowns, as normal as they are for many samples."""
        fit = pair.fit
        v = covariance(fit, self.said.rod.replicas)
        random = np.random.default_rng(self.seed)
        z = random.multivariate_normal(fit.z, 0.5 * (v + v.T), NUM_DRAWS, method="eigh") if len(fit.z) else None
        z = np.zeros((NUM_DRAWS, 0)) if z is None else z
        return np.maximum(z, fit.problem.floor)

    def compose(self, seconds: float) -> finding.Finding:
        """The whole content of diagnosis.json."""
        said = self.said
        effects = tuple(self._effect(i) for i in range(len(said.places)))
        named = effects if said.verdict == "mismatch" else ()
        candidates = self._candidates()
        fit, psi = self._scores(), self._psi()
        where = by_element(named)
        if named:
            between = shares(said.before, said.after)
            known = {e["name"] for e in where if e["kind"] == "contact"}
            where += [{"kind": "contact", "name": n, "share": s} for n, s in between.items() if n not in known]
        worst, ratio = worst_column(said)
        return finding.Finding.model_validate(
            {
                "verdict": said.verdict,
                "summary": self._summary(named, candidates, fit, psi),
                "evidence": {
                    "log10_bayes_factor": log10_bayes(said.before, said.after) if said.places else 0.0,
                    "noise_inflation": 1.0 + max(said.excess, 0.0),
                },
                "where": {"elements": where, "when": [{"condition": c.text, "share": c.share} for c in self.when]},
                "effects": named,
                "candidates": candidates,
                "experiment": self._experiment(candidates),
                "fit": fit,
                "psi": psi,
                "seconds": seconds,
                "versions": {name: version(name) for name in PACKAGES},
                "seed": self.seed,
                "belief": {"before": self._belief(said.before), "after": self._belief(said.shown)},
                "predictive_check": {"p_value": None, "worst_channel": worst, "inflation": ratio},
                "contact": {"memory": _memories(said), "finer_integration": said.finer > 1},
                "negligible": [
                    {"name": p.placed.effect.name, "element": element(p.placed).model_dump(), "explains": s}
                    for p, s in said.negligible
                ],
            }
        )

    def _belief(self, pair: Pair) -> dict[str, Any]:
        """How its draws were made: they cost nothing, but refits to replicas that correct their covariance do."""
        evaluations = self.said.rod.evaluations if corrected(pair.fit, self.said.rod.replicas) else 0
        return {"method": "laplace", "k_hat": None, "draws": NUM_DRAWS, "evaluations": evaluations}

    def _effect(self, i: int) -> finding.Effect:
        said = self.said
        mine, *rest = said.places[i]
        placed = said.after.fit.problem.effects[i]
        z = self._draws(said.after)
        given = parameters(said.after.fit, placed, z)
        others = [m for m in mine.members if m.placed != placed]
        equally = tuple(m.placed.label.replace("_", " ") for m in others)
        return finding.Effect(
            name=placed.effect.name,
            element=element(placed),
            law=placed.effect.law_text,
            statement=statement(placed, given, equally),
            probability=min(mine.chance, 1.0),
            explains=said.explains[i],
            recordings="all",
            parameters=dict(given),
            equivalent=tuple(
                finding.Equivalent(
                    name=m.placed.effect.name,
                    element=element(m.placed),
                    parameters=dict(parameters(m.fit, m.placed, self._draws(m))),
                )
                for m in others
            ),
            alternatives=tuple(_alternative(c) for c in rest[:5]),
        )

    def _candidates(self) -> list[finding.Alternative]:
        """What could stand in the place that is least certain, or beside what is named."""
        said = self.said
        unsure = said.places if said.verdict == "inconclusive" else [said.open_place] if said.open_place else []
        place = min(unsure, key=lambda p: p[0].chance, default=())
        return sorted((_alternative(c) for c in place), key=lambda a: -a.probability)[:8]

    def _experiment(self, candidates: list[finding.Alternative]) -> dict[str, Any] | None:
        if not candidates:
            return None
        return {"text": proposed(candidates), "input": None, "initial_state": None, "expected_gain": None}

    def _scores(self) -> finding.Fit:
        said = self.said
        before, after = said.before, said.shown
        gain = before.held.losses - after.held.losses
        owner = before.held.followed.recording
        each = np.bincount(owner, gain) if len(gain) else np.zeros(0)
        columns = before.fit.problem.segments.columns
        runs = {k: self.runs[k]["held"] for k in ("before", "after")}
        rmse = {k: r.rmse() for k, r in runs.items()}
        return finding.Fit(
            horizon_s=runs["before"].horizon,
            heldout_log_density_before=-float(before.held.losses.sum()),
            heldout_log_density_after=-float(after.held.losses.sum()),
            difference=float(gain.sum()),
            standard_error=float(np.std(each, ddof=1) * np.sqrt(len(each))) if len(each) > 1 else None,
            rollout_rmse_before=dict(zip(columns, rmse["before"].tolist(), strict=True)),
            rollout_rmse_after=dict(zip(columns, rmse["after"].tolist(), strict=True)),
            rollout_rmse_noise=dict(zip(columns, before.fit.problem.noise.tolist(), strict=True)),
            unexplained_share=said.unexplained if said.verdict == "mismatch" else float(said.exceeds),
            heldout_chose=bool(self.study.holdout) and bool(said.places),
        )

    def _psi(self) -> dict[str, finding.PsiChange]:
        out = {}
        pairs = {"before": self.said.before, "after": self.said.shown}
        before, after = (psi_moments(p.fit, self.draws[k]) for k, p in pairs.items())
        here = self.said.shown.fit
        for j, p in enumerate(self.study.parameters):
            tail = tail_probability(p, float(here.problem.psi(here.z)[j]))
            out[p.name] = finding.PsiChange(before=before[p.name], after=after[p.name], prior_conflict=tail)
        return out

    def _summary(self, effects, candidates, fit: finding.Fit, psi) -> str:
        """In words; what contradicts the model's gravity in flight is said beside what names nothing."""
        found = self._found(effects, candidates, fit, psi)
        odd = [] if effects else [f.text for f in falls(self.said.before.fit.problem) if f.contradicts]
        return " ".join([found, *odd])

    def _found(self, effects, candidates, fit: finding.Fit, psi) -> str:
        said = self.said
        if said.verdict == "no_mismatch":
            return self._all_well(psi)
        if said.verdict == "inconclusive":
            each = likeliest(candidates)
            if said.unexplained >= 0.5:
                return (
                    f"Something was left out; the nearest in the catalogue, {each[0]}, leaves "
                    f"{said.unexplained:.0%} of the error beyond noise and contact unexplained."
                )
            if said.strained:
                return (
                    f"Something was left out; the nearest in the catalogue, {', '.join(each)}, may stand for something "
                    f"else: {', '.join(said.strained)} lies far out in its prior beside it."
                )
            if said.told_worse:
                return (
                    f"Something was left out; the nearest in the catalogue, {each[0]}, foretells "
                    f"{', '.join(said.told_worse)} of recordings that were not fitted worse than the believed model."
                )
            return f"Something was left out, but the recordings do not tell what: {', '.join(each)}."
        gone = drop(fit, "it" if len(effects) == 1 else "them")
        told = [*(e.statement for e in effects), gone, open_beside(candidates), self._finer()]
        return " ".join(t for t in told if t)

    def _finer(self) -> str:
        if self.said.finer == 1:
            return ""
        return f"Steps {self.said.finer} times as short tell the recordings better; all that is told is by them."

    def _all_well(self, psi) -> str:
        said = self.said
        count = len(said.rounds[0].screened)
        text = f"Nothing in the catalogue ({count} candidates) explains the recordings better than the model."
        worst, ratio = worst_column(said)
        if said.excess > LARGE - 1:
            text += (
                f" But they stay unexplained: over short stretches the squared error of {worst} is {ratio:.3g} times "
                "what the model itself would leave."
            )
        odd = [n for n, p in psi.items() if isinstance(p.prior_conflict, float) and p.prior_conflict < UNLIKELY]
        if odd:
            text += f" But {', '.join(odd)} lies far out in its prior: the believed value or its prior is wrong."
        if said.negligible:
            names = ", ".join(p.placed.label.replace("_", " ") for p, _ in said.negligible)
            text += f" Significant but negligible (under {NEGLIGIBLE:.0%} of the error): {names}."
        return " ".join(t for t in (text, self._finer()) if t)

    def arrays(self) -> result.DataTree:
        """Draws, short rollouts and the ranking of candidates: fit.nc."""
        said = self.said
        groups = {
            "before/posterior": result.posterior(said.before.fit, self.draws["before"]),
            "after/posterior": result.posterior(said.shown.fit, self.draws["after"]),
        }
        kinds = (("recordings", "fit", self.study.recordings), ("holdout", "held", self.study.holdout))
        runs = {}
        for role, name, recordings in kinds:
            earlier, later = (self.runs[k][name].paths() for k in ("before", "after"))
            there = tuple(r for r in recordings if r.name in earlier)
            if there:
                runs |= result.rollouts(said.before.fit, earlier, later, there, role, self.when)
        groups |= {f"rollouts/{stem}": data for stem, data in runs.items()}
        groups |= replay(said.before.fit.problem.simulator, runs, lambda _: {})  # stretches keep no states
        groups["screening"] = result.ranking(self._ranking())
        return result.DataTree.from_dict(groups)

    def _ranking(self) -> list[tuple[str, str, str, float, float, str]]:
        first = self.said.rounds[0]
        base = first.base.losses.sum()
        gains = {p.placed: float(base - p.losses.sum()) for p in first.refined}
        chance = {m.placed: c.chance for place in self.said.places[:1] for c in place for m in c.members}
        told = {s.placed: s.gain for s in first.screened} | gains  # curves were not screened beside the others
        return [(p.effect.name, p.element.kind, p.element.name, g, chance.get(p, 0.0), "") for p, g in told.items()]


def _alternative(c: Class) -> finding.Alternative:
    placed = c.members[0].placed
    named = {"name": placed.effect.name, "element": element(placed), "probability": min(c.chance, 1.0)}
    return finding.Alternative.model_validate(named | variables(placed))


def _memories(said: Verdict) -> dict[str, float]:
    """Samples by which each hypothesis is led."""
    return {"before": said.before.fit.followed.memory, "after": said.shown.fit.followed.memory}
