"""The diagnosis of a study: is something left out, where, what, how sure, and how much better with it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.stats import norm

from det2stoc_bayes.errors import SimulationDiverged
from det2stoc_bayes.files import atomic_write, replacing
from det2stoc_bayes.mismatch import finding, result
from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.classes import Class, classes
from det2stoc_bayes.mismatch.effects import CATALOGUE
from det2stoc_bayes.mismatch.evidence import log_evidence
from det2stoc_bayes.mismatch.experiment import propose
from det2stoc_bayes.mismatch.explain import Explanation, explain, swap, without
from det2stoc_bayes.mismatch.heldout import HeldOut, fitted, held_out, horizon_samples
from det2stoc_bayes.mismatch.horizon import climb
from det2stoc_bayes.mismatch.numerics import Numerics, check_numerics
from det2stoc_bayes.mismatch.patch import Patch, make_patch
from det2stoc_bayes.mismatch.statements import alternatives, draws, element, parameters, statement
from det2stoc_bayes.mismatch.where import Condition, conditions
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import Study

Progress = Callable[[str, int, int], None]
NEGLIGIBLE = 0.05  # of the held-out squared error beyond noise
SURE = finding.SURE
STAGES = 6


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """A finding, the arrays behind it, and the corrected simulator."""

    finding: finding.Finding
    tree: xr.DataTree
    patch: Patch
    study: Study

    def write(self, out: Path) -> None:
        """All files of a diagnosis; each appears whole or not at all, diagnosis.json last."""
        from det2stoc_bayes.report import diagnosis_page

        out.mkdir(parents=True, exist_ok=True)
        names = ["patched.xml", *(["effects.py"] if self.patch.module else []), "fit.nc", "diagnosis.json"]
        page = diagnosis_page(self.finding.model_dump(mode="json"), self.tree, study_name=self.study.name, files=tuple(names))
        for name, path in self.patch.assets.items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            atomic_write(out / name, path.read_bytes())
        atomic_write(out / "patched.xml", self.patch.model)
        if self.patch.module:
            atomic_write(out / "effects.py", self.patch.module)
        else:
            (out / "effects.py").unlink(missing_ok=True)  # of an earlier diagnosis
        with replacing(out / "fit.nc") as path:
            self.tree.to_netcdf(path, engine="h5netcdf")
        atomic_write(out / "report.html", page)
        finding.write_json(self.finding, out / "diagnosis.json")


@dataclass(frozen=True, eq=False)
class _Named:
    """An effect that was named: its class, its share of the held-out error, its place in the list."""

    chosen: Class
    explains: float
    slot: int
    rest: list[Class]


def diagnose(study: Study, *, seed: int = 0, progress: Progress = lambda *_: None) -> Diagnosis:
    """Locate, name and model what the believed model leaves out.

    Raises SimulationDiverged where the believed model cannot follow the recordings at all.
    """
    began = time.perf_counter()
    simulator = Simulator(study)
    progress("fitting the believed model", 0, 1)
    before = climb(make_problem(simulator))
    if before is None:
        raise SimulationDiverged(
            f"{study.model_path}: the simulation diverges from every recorded start; "
            "check units, the timestep and the initial states of the recordings")
    progress("fitting the believed model", 1, 1)
    pool = candidates(before.problem)
    numerics = check_numerics(before, float(simulator.model.opt.timestep), len(pool))
    found = explain(before if numerics is None else numerics.fit, pool, progress)
    believed = found.before if numerics is None else _believed(found.before, before)
    return _Assembly(study, believed, found, numerics, seed, began, progress).build()


def _believed(corrected: Fit, believed: Fit) -> Fit:
    """The believed timestep's fit on the segments that the explanation ended with."""
    if corrected.problem.segments.count == believed.problem.segments.count:
        return believed
    plain = replace(corrected.problem, timestep=None, integrator=None)
    return climb(plain, believed.point.z) or believed


class _Assembly:
    """Puts a finding together from an explanation."""

    def __init__(self, study, before: Fit, found: Explanation, numerics: Numerics | None, seed, began, progress):
        self.study, self.found, self.numerics, self.seed, self.began = study, found, numerics, seed, began
        self.progress, self.before, self.after = progress, before, found.after
        self.num_candidates = found.num_candidates

    def build(self) -> Diagnosis:
        """Verdict, sentences, files."""
        self.progress("scoring held-out recordings", 0, 3)
        self.held_before = held_out(self.before)
        self.progress("scoring held-out recordings", 1, 3)
        judged = [classes(slot, self.num_candidates, self.found.share) for slot in self.found.slots]
        self._simplify(judged)
        self._drop_negligible(judged)
        self.held_after = self.held_before if self.after is self.before else held_out(self.after)
        self.progress("scoring held-out recordings", 2, 3)
        self.z = draws(self.after, self.found.share, self.seed)
        self.z_before = draws(self.before, self.found.share, self.seed)
        verdict = self._verdict()
        self.when = self._conditions() if verdict == "mismatch" else []
        self.progress("scoring held-out recordings", 3, 3)
        tree = self._tree(judged)
        values = self.after.problem.effect_values(self.after.point.z[None])
        shown = self.after if verdict == "mismatch" else self.before
        psi = {p.name: float(np.mean(v)) for p, v in zip(
            self.study.parameters, shown.problem.psi(self.z if shown is self.after else self.z_before).T, strict=True)}
        effects = [(e, {k: float(v[0]) for k, v in p.items()})
                   for e, p in zip(self.after.problem.effects, values, strict=True)] if verdict == "mismatch" else []
        options = {"timestep": shown.problem.timestep, "integrator": shown.problem.integrator}
        patch = make_patch(self.study, psi, effects, **options)
        return Diagnosis(self._finding(verdict, judged), tree, patch, self.study)

    # --- verdict ------------------------------------------------------------------------------------------------
    def _simplify(self, judged: list[list[Class]]) -> None:
        """Of every class the simplest member stands in the corrected simulator."""
        for i, placed in enumerate(self.after.problem.effects):
            chosen = next(c for c in judged[i] if any(m.placed == placed for m in c.members))
            self.after = swap(self.after, i, chosen.members[0])

    def _drop_negligible(self, judged: list[list[Class]]) -> None:
        """Effects that earn evidence but explain next to nothing are set apart, and the rest refitted without them."""
        self.named, self.negligible = [], []
        keep = []
        whole = held_out(self.after) if self.after.problem.effects else self.held_before
        for i, placed in enumerate(self.after.problem.effects):
            one = len(self.after.problem.effects) == 1 and self.numerics is None
            base = self.held_before if one else held_out(without(self.after, i))
            share = self._share(base, whole)
            if share < NEGLIGIBLE:
                self.negligible.append((placed, share))
                continue
            keep.append(placed)
            chosen = next(c for c in judged[i] if any(m.placed == placed for m in c.members))
            self.named.append(_Named(chosen, share, i, [c for c in judged[i] if c is not chosen]))
        if self.negligible and self.after.problem.effects:
            fit = self.after
            for placed, _ in self.negligible:
                fit = without(fit, list(fit.problem.effects).index(placed))
            self.after = fit if fit.problem.effects or self.numerics is not None else self.before
        self.numerics_share = 0.0
        if self.numerics is not None:
            plain = self.found.before if not self.found.after.problem.effects else self.numerics.fit
            self.numerics_share = self._share(self.held_before, held_out(plain))
            if self.numerics_share < NEGLIGIBLE and not self.named:
                self.after = self.before

    def _share(self, base: HeldOut, better: HeldOut) -> float:
        """Share of the believed model's held-out squared excess that goes when `base` becomes `better`."""
        excess = self.held_before.chi2.sum() - self.held_before.num_values.sum()
        # Chance alone makes an excess of a few standard deviations of chi2.
        if not excess > 3 * np.sqrt(2 * self.held_before.num_values.sum()):
            return 0.0
        return float(np.clip((base.chi2.sum() - better.chi2.sum()) / excess, -1.0, 1.0))

    def _verdict(self) -> str:
        numeric = self.numerics is not None and self.numerics_share >= NEGLIGIBLE
        if not self.named and not numeric:
            return "no_mismatch"
        return "mismatch" if all(n.chosen.probability >= SURE for n in self.named) else "inconclusive"

    def _conditions(self) -> list[Condition]:
        return [c for n in self.named for c in conditions(self.after, self._place(n))]

    def _place(self, named: _Named) -> int:
        member = {m.placed for m in named.chosen.members}
        return next(i for i, e in enumerate(self.after.problem.effects) if e in member)

    # --- parts of the finding -----------------------------------------------------------------------------------
    def _effect(self, named: _Named) -> finding.Effect:
        present = self.after.problem.effects[self._place(named)]
        first, *others = named.chosen.members
        listed = {}
        for m in (first, *others):
            fit, z = (self.after, self.z) if m.placed == present else (m.fit, draws(m.fit, self.found.share, self.seed))
            listed[m.placed] = parameters(fit, m.placed, z)
        equally = tuple(m.placed.label.replace("_", " ") for m in others)
        return finding.Effect(
            name=first.placed.effect.name, element=element(first.placed), law=first.placed.effect.law_text,
            statement=statement(first.placed, listed[first.placed], equally), probability=min(named.chosen.probability, 1.0),
            explains=named.explains, recordings="all", parameters=listed[first.placed],
            equivalent=[finding.Equivalent(name=m.placed.effect.name, element=element(m.placed), parameters=listed[m.placed])
                        for m in others],
            alternatives=alternatives(named.rest))

    def _numerical(self) -> finding.Effect:
        assert self.numerics is not None
        law = CATALOGUE["numerical_integration"].law_text
        step = self.numerics.timestep
        return finding.Effect(
            name="numerical_integration", element=finding.Element(kind="simulator", name="option"), law=law,
            statement=f"The believed timestep is too coarse: {step:g} s with {self.numerics.integrator} converges.",
            probability=float(1 / (1 + np.exp(-min(self.numerics.gain, 700.0)))), explains=self.numerics_share,
            recordings="all", equivalent=[], alternatives=[],
            parameters={"timestep": finding.Quantity(mean=step, sd=0.0, interval=[step, step], unit="s"),
                        "integrator": self.numerics.integrator})

    def _finding(self, verdict: str, judged) -> finding.Finding:
        effects = [self._effect(n) for n in self.named]
        if self.numerics is not None and self.numerics_share >= NEGLIGIBLE:
            effects.insert(0, self._numerical())
        doubtful = next((n for n in self.named if n.chosen.probability < SURE), None)
        listed, experiment = [], None
        if verdict == "inconclusive" and doubtful is not None:
            every = sorted([doubtful.chosen, *doubtful.rest], key=lambda c: -c.probability)
            listed = alternatives(every, 8)
            second = every[1] if len(every) > 1 else every[0]
            p = propose(every[0].members[0].fit, second.members[0].fit)
            experiment = finding.Experiment(text=p.text, input=p.input, initial_state=p.initial_state, expected_gain=p.expected_gain)
        found = effects if verdict == "mismatch" else []
        fit = self._scores()
        extra = {"seed": self.seed, "negligible": [
            {"name": p.effect.name, "element": {"kind": p.element.kind, "name": p.element.name}, "explains": s}
            for p, s in self.negligible]}
        return finding.Finding(
            verdict=verdict, summary=self._summary(verdict, found, listed, fit),
            evidence={"log10_bayes_factor": self._bayes_factor(judged), "noise_inflation": self._inflation()},
            where=self._where(found), effects=found, candidates=listed, experiment=experiment, fit=fit, psi=self._psi(),
            seconds=time.perf_counter() - self.began,
            versions={n: version(n) for n in ("det2stoc-bayes", "mujoco", "numpy", "scipy")}, **extra)

    def _bayes_factor(self, judged) -> float:
        gains = [slot[0].members[0].gain for slot in judged if slot]
        if self.after is not self.before:
            gains.append(log_evidence(self.after, self.found.share) - log_evidence(self.before, self.found.share))
        return max(gains, default=0.0) / np.log(10)

    def _inflation(self) -> float | None:
        given = all(c in self.study.noise for c in self.before.problem.segments.columns)
        return self.before.noise_inflation if given else None

    def _where(self, effects: list[finding.Effect]) -> dict:
        total = sum(max(e.explains or 0.0, 0.0) for e in effects) or 1.0
        shares: dict[tuple[str, str], float] = {}
        for e in effects:
            key = (e.element.kind, e.element.name)
            shares[key] = shares.get(key, 0.0) + max(e.explains or 0.0, 0.0) / total
        elements = [{"kind": k, "name": n, "share": min(s, 1.0)} for (k, n), s in shares.items()]
        return {"elements": elements, "when": [{"condition": c.text, "share": c.share} for c in self.when]}

    def _scores(self) -> finding.Fit:
        before, after = self.held_before, self.held_after
        gain = after.log_density - before.log_density
        columns = self.before.problem.segments.columns
        excess = before.chi2.sum() - before.num_values.sum()
        left = max(after.chi2.sum() - after.num_values.sum(), 0.0) / excess if excess > 0 else 0.0
        samples, records = horizon_samples(self.before), self.study.holdout or self.study.recordings
        spans = [r.time[-1] - r.time[0] for r in records]
        horizon = max(spans) if samples is None else float(np.median(
            [r.time[min(samples, len(r.time)) - 1] - r.time[0] for r in records]))
        return finding.Fit(
            horizon_s=float(horizon), heldout_log_density_before=float(before.log_density.sum()),
            heldout_log_density_after=float(after.log_density.sum()), difference=float(gain.sum()),
            standard_error=float(np.std(gain, ddof=1) * np.sqrt(len(gain))) if len(gain) > 1 else None,
            rollout_rmse_before=dict(zip(columns, before.rmse, strict=True)),
            rollout_rmse_after=dict(zip(columns, after.rmse, strict=True)),
            rollout_rmse_noise=dict(zip(columns, self.before.problem.noise, strict=True)),
            unexplained_share=float(min(left, 1.0)))

    def _psi(self) -> dict[str, finding.PsiChange]:
        out = {}
        before, after = self.before.problem.psi(self.z_before), self.after.problem.psi(self.z)
        for j, p in enumerate(self.study.parameters):
            tail = 2 * float(norm.sf(abs(self.after.point.z[j])))
            out[p.name] = finding.PsiChange(
                before={"mean": before[:, j].mean(), "sd": before[:, j].std()},
                after={"mean": after[:, j].mean(), "sd": after[:, j].std()}, prior_conflict=min(tail, 1.0))
        return out

    def _summary(self, verdict, effects, listed, fit: finding.Fit) -> str:
        if verdict == "no_mismatch":
            conflict = [n for n, p in self._psi().items() if p.prior_conflict < 0.01]
            text = f"Nothing in the catalogue ({self.num_candidates} candidates) explains the recordings better than the model."
            if conflict:
                text += f" But {', '.join(conflict)} lies far out in its prior: the believed value or its prior is wrong."
            elif self.negligible:
                names = ", ".join(p.label.replace("_", " ") for p, _ in self.negligible)
                text += f" Significant but negligible (under {NEGLIGIBLE:.0%} of the error): {names}."
            return text
        if verdict == "inconclusive":
            names = ", ".join(f"{c.name.replace('_', ' ')} on {c.element.name} ({c.probability:.0%})" for c in listed[:3])
            return f"Something was left out, but the recordings do not tell what: {names}."
        drops = [1 - a / b for a, b in zip(fit.rollout_rmse_after.values(), fit.rollout_rmse_before.values(), strict=True)
                 if a is not None and b]
        drop = f" With {'it' if len(effects) == 1 else 'them'} the held-out error falls by {max(drops):.0%}." if drops else ""
        return " ".join(e.statement for e in effects) + drop

    # --- arrays -------------------------------------------------------------------------------------------------
    def _tree(self, judged) -> xr.DataTree:
        study = self.study
        fit_before = fitted(self.before)
        fit_after = fit_before if self.after is self.before else fitted(self.after)
        groups = {"before/posterior": result.posterior(self.before, self.z_before),
                  "after/posterior": result.posterior(self.after, self.z)}
        runs = result.rollouts(self.before, fit_before, fit_after, study.recordings, "recordings", self.when)
        if study.holdout:
            runs |= result.rollouts(self.before, self.held_before, self.held_after, study.holdout, "holdout", self.when)
        groups |= {f"rollouts/{name}": data for name, data in runs.items()}
        chance = {m.placed.label: c.probability for slot in judged[:1] for c in slot for m in c.members}
        groups["screening"] = result.screening(self.found.slots[0], chance, {})
        return xr.DataTree.from_dict(groups)


