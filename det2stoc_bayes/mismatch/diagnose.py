"""The diagnosis of a study: is something left out, where, what, how sure, and how much better with it."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from det2stoc_bayes.engines.model_names import model_files
from det2stoc_bayes.errors import MethodNotApplicable, SimulationDiverged
from det2stoc_bayes.files import atomic_write, check_kept
from det2stoc_bayes.mismatch import finding, result
from det2stoc_bayes.mismatch.belief import Sampler, Temper
from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.compose import Composer
from det2stoc_bayes.mismatch.conflict import as_well, in_doubt, needless, resolved
from det2stoc_bayes.mismatch.contact.run import diagnosed, touches
from det2stoc_bayes.mismatch.credence import weigh
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import by_chance, effective_share, log_evidence
from det2stoc_bayes.mismatch.explain import Explanation
from det2stoc_bayes.mismatch.horizon import climb, reaches
from det2stoc_bayes.mismatch.judgement import Judgement, judge
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.numerics import Numerics, check_numerics, of_believed, simulated
from det2stoc_bayes.mismatch.patch import Patch, make_patch
from det2stoc_bayes.mismatch.race import threshold
from det2stoc_bayes.mismatch.replay import replay, states_of
from det2stoc_bayes.mismatch.undecided import without_undecided
from det2stoc_bayes.mismatch.unlisted import explain_by_all
from det2stoc_bayes.mismatch.where import conditions
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.posterior import to_bytes
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import Study

Progress = Callable[[str, int, int], None]  # stage, done, of how many


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """A finding, the arrays behind it, and the corrected simulator."""

    finding: finding.Finding
    tree: result.DataTree
    patch: Patch
    study: Study

    def write(self, out: str | os.PathLike[str]) -> None:
        """All files of a diagnosis; each appears whole or not at all, diagnosis.json last."""
        from det2stoc_bayes.report import diagnosis_page

        out = Path(out)
        names = ["patched.xml", *(["effects.py"] if self.patch.module else []), "fit.nc", "diagnosis.json"]
        content = self.finding.model_dump(mode="json")
        page = diagnosis_page(content, self.tree, study_name=self.study.name, files=tuple(names))
        check_kept((out / name for name in names), model_files(self.study.model_path))
        out.mkdir(parents=True, exist_ok=True)
        for name, path in self.patch.assets.items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            atomic_write(out / name, path.read_bytes())
        atomic_write(out / "patched.xml", self.patch.model)
        if self.patch.module:
            atomic_write(out / "effects.py", self.patch.module)
        else:
            (out / "effects.py").unlink(missing_ok=True)  # of an earlier diagnosis
        atomic_write(out / "fit.nc", to_bytes(self.tree))
        atomic_write(out / "report.html", page)
        finding.write_json(self.finding, out / "diagnosis.json")


def diagnose(
    study: Study,
    *,
    seed: int = 0,
    progress: Progress = lambda *_: None,
    temper: Temper | None = None,
    sampler: Sampler | None = None,
) -> Diagnosis:
    """Locate, name and model what the believed model leaves out.

    `temper` draws where importance sampling fails; `sampler` draws the final posteriors in place of the cheap way,
    with which it is compared (`verbs.diagnose` passes those of `inference`).

    Raises SimulationDiverged where the believed model cannot follow the recordings at all.
    """
    began = time.perf_counter()
    simulator = Simulator(study)
    progress("fitting the believed model", 0, 1)
    problem = make_problem(simulator)
    if touches(problem):
        if sampler is not None:
            raise MethodNotApplicable(
                f"{study.model_path}: bodies touch, and simulations that follow their recordings have no density that "
                "NUTS could draw from; allowed: a diagnosis without --exact"
            )
        composer, patch = diagnosed(problem, seed, progress)
        return Diagnosis(composer.compose(time.perf_counter() - began), composer.arrays(), patch, study)
    declared = climb(problem)
    if declared is None:
        raise SimulationDiverged(
            f"{study.model_path}: the simulation diverges from every recorded start; "
            "check units, the timestep and the initial states of the recordings"
        )
    progress("fitting the believed model", 1, 1)
    before, search = _by_priors_that_hold(declared, progress)
    progress("scoring held-out recordings", 0, 1)

    def judge_anew(found: Explanation) -> Judgement:
        plain = found.before if search.numerics is None else _believed(found.before, before)
        return judge(plain, found, search.numerics)

    judged = without_undecided(judge_anew(search.found), judge_anew, search.pool, search.looks)
    places = [list(judged.after.problem.effects).index(n.placed) for n in judged.named]
    when = [c for i in places for c in conditions(judged.after, i)] if judged.verdict == "mismatch" else []
    progress("scoring held-out recordings", 1, 1)
    judged, credence = weigh(judged, seed, temper=temper, sampler=sampler, progress=progress)
    composer = Composer(judged, credence, when, seed)
    tree, patch = _arrays(judged, composer), _patch(judged, composer)
    return Diagnosis(composer.compose(time.perf_counter() - began), tree, patch, study)


@dataclass(frozen=True, eq=False)
class _Search:
    """What is missing beside a fit of the believed model, among which candidates, and how long that was looked for."""

    numerics: Numerics | None  # where the believed timestep has not converged
    found: Explanation
    pool: list[PlacedEffect]
    looks: Looks

    @property
    def effects(self) -> tuple[PlacedEffect, ...]:
        """The effects that explain."""
        return self.found.after.problem.effects


def _by_priors_that_hold(declared: Fit, progress: Progress) -> tuple[Fit, _Search]:
    """The believed model's fit, under wider priors than the declared where these are wrong, and what is missing beside.

    What is missing may be what strained them: then effects are looked for under the declared ones.
    """
    before = resolved(declared) or declared
    search = _search(before, progress)
    if before is declared or not search.effects:
        return before, search
    after = search.found.after
    hold = needless(after, declared)
    if hold or in_doubt(after, declared):
        other = _search(declared, progress)
        if hold or as_well(other.found.after, after):
            return declared, other
    return before, search


def _search(before: Fit, progress: Progress) -> _Search:
    """By all candidates, at a timestep that converges, or by the steps of what was recorded of a simulation.

    What is missing may hide from the believed model how far its steps err: that is asked for once more beside the
    effect that explains most, and beside all that was found.
    """
    pool, looks = candidates(before.problem), Looks(progress)
    step, count = float(before.problem.simulator.model.opt.timestep), len(pool)

    def leader(fit: Fit, looks: Looks) -> Fit:
        ranked = [] if by_chance(fit) else looks.at(fit, pool).ranked
        return looks.extended(ranked[0].fit) if ranked and ranked[0].gain >= threshold(count) else fit

    def as_simulated(fit: Fit, gained: float, looks: Looks | None) -> Numerics | None:
        told = simulated(fit, step, count, gained)
        if told is None or looks is None:
            return told
        rival = leader(fit, looks)  # a late sensor looks like an error of steps, to first order
        better = rival is not fit and by_chance(rival) and _tells_more(rival, looks.extended(told.fit))
        return None if better else told

    def by(numerics: Numerics, looks: Looks) -> _Search:
        return _Search(numerics, explain_by_all(numerics.fit, pool, looks), pool, looks)

    def at(numerics: Numerics, looks: Looks) -> _Search:
        first = numerics.fit if numerics.simulated else leader(numerics.fit, looks)
        told = None if first is numerics.fit else as_simulated(first, numerics.gain, looks)
        told = None if told is None else of_believed(told, before)
        return by(numerics, looks) if told is None else by(told, Looks(progress))

    def error_at(fit: Fit, looks: Looks | None) -> tuple[Numerics | None, Looks]:
        found = check_numerics(fit, step, count)
        own = looks if found is None or looks is None else Looks(progress)
        told = as_simulated(fit, 0.0, own) if found is None else as_simulated(found.fit, found.gain, own)
        return (told, Looks(progress)) if told is not None else (found, own or Looks(progress))

    def beside(fit: Fit, looks: Looks | None) -> Numerics | None:
        if not fit.problem.effects or by_chance(fit):
            return None
        found, _ = error_at(fit, looks)
        return None if found is None else of_believed(found, before)

    numerics, own = error_at(before, looks)
    if numerics is not None:
        return at(numerics, own)
    first = leader(before, looks)
    numerics = beside(first, looks)
    if numerics is not None:
        return at(numerics, Looks(progress))
    plain = _Search(None, explain_by_all(before, pool, looks), pool, looks)
    after = plain.found.after
    numerics = None if after is first else beside(after, None)
    again = plain if numerics is None else at(numerics, Looks(progress))
    return again if _tells_more(again.found.after, after) else plain


def _tells_more(fit: Fit, other: Fit) -> bool:
    """Whether a fit tells the same stretches better than another, or longer ones."""
    if fit.problem.segments.extent != other.problem.segments.extent:
        return reaches(fit, other)
    share = effective_share(fit)
    return bool(log_evidence(fit, share) > log_evidence(other, share))


def _believed(corrected: Fit, believed: Fit) -> Fit:
    """The believed timestep's fit on the segments that the explanation ended with."""
    if corrected.problem.segments.extent == believed.problem.segments.extent:
        return believed
    plain = replace(corrected.problem, timestep=None, integrator=None)
    return climb(plain, believed.point.z) or believed


def _patch(judged: Judgement, composer: Composer) -> Patch:
    """The corrected simulator at posterior means of psi and of the named effects."""
    shown, study = judged.shown.problem, composer.study
    belief = composer.credence.after if judged.verdict == "mismatch" else composer.credence.before
    means = belief.fit.problem.psi(belief.z).mean(0).tolist()
    psi = dict(zip((p.name for p in study.parameters), means, strict=True))
    values = shown.effect_values(judged.shown.point.z[None])
    effects = [(e, {k: v[0] for k, v in p.items()}) for e, p in zip(shown.effects, values, strict=True)]
    step = shown if shown.finer is None else shown.finer
    return make_patch(study, psi, effects, timestep=step.timestep, integrator=step.integrator)


def _arrays(judged: Judgement, composer: Composer) -> result.DataTree:
    """Draws, rollouts and the ranking of candidates: fit.nc."""
    study, before, after = composer.study, judged.before, judged.after
    fit_before = result.fitted_paths(before)
    fit_after = fit_before if after is before else result.fitted_paths(after)
    groups = {
        "before/posterior": result.posterior(composer.credence.before.fit, composer.credence.before.z),
        "after/posterior": result.posterior(composer.credence.after.fit, composer.credence.after.z),
    }
    runs = result.rollouts(before, fit_before, fit_after, study.recordings, "recordings", composer.when)
    if study.holdout:
        held = judged.held_before.rollouts, judged.held_after.rollouts
        runs |= result.rollouts(before, *held, study.holdout, "holdout", composer.when)
    groups |= {f"rollouts/{name}": data for name, data in runs.items()}
    groups |= replay(before.problem.simulator, runs, states_of(before, after, judged.held_before.samples))
    chance = {m.placed.label: c.probability for place in judged.places[:1] for c in place for m in c.alike}
    groups["screening"] = result.screening(judged.found.slots[0], chance)
    return result.DataTree.from_dict(groups)
