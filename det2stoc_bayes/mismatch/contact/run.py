"""The diagnosis of a study in which bodies touch."""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.engines.contacts import share_in_contact
from det2stoc_bayes.errors import SimulationDiverged
from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact.compose import ContactComposer
from det2stoc_bayes.mismatch.contact.judge import Verdict, judged
from det2stoc_bayes.mismatch.contact.pair import (
    Pair,
    converged,
    exchanged_pairs,
    held_out,
    settled,
    shifted,
)
from det2stoc_bayes.mismatch.contact.places import conditions, elements_of
from det2stoc_bayes.mismatch.contact.search import MAX_EFFECTS, Progress, Round, look
from det2stoc_bayes.mismatch.contact.telling import telling
from det2stoc_bayes.mismatch.contact.window_fit import WindowFit
from det2stoc_bayes.mismatch.contact.window_starts import smoothed
from det2stoc_bayes.mismatch.contact.windows import make_windows
from det2stoc_bayes.mismatch.patch import Patch, make_patch
from det2stoc_bayes.problem import Problem

TOUCHES = 0.02  # share of states in contact from which a study is one with contact
EVERY = 4  # without held-out recordings, of how many one is not fitted


def touches(problem: Problem) -> bool:
    """Whether bodies touch often enough for derivatives to fail."""
    short = make_windows(problem).problem
    return share_in_contact(short) >= TOUCHES


def diagnosed(problem: Problem, seed: int, progress: Progress) -> tuple[ContactComposer, Patch]:
    """What is to be written of a study, and the corrected simulator."""
    progress("fitting the believed model", 0, 1)
    before, fine = _believed(problem)
    progress("fitting the believed model", 1, 1)
    # Of a lone recording nothing is held out, and nothing can be proven.
    alone = len(problem.simulator.study.recordings) == 1 and not problem.simulator.study.holdout
    pool = [] if alone else candidates(before.fit.problem, elements_of(before.fit.windows, before.fit.z))
    base, rounds = before, []
    while len(rounds) < MAX_EFFECTS:
        one = look(base, pool, progress, seed) if pool else Round(base, (), (), None)
        rounds.append(one)
        if one.taken is None:
            break
        base = one.taken
    progress("scoring held-out recordings", 0, 1)
    if base is not before:
        before, base = exchanged_pairs([before, base])
    said = judged(before, rounds, fine, seed, base)
    when = conditions(said.before, said.after) if said.verdict == "mismatch" else []
    progress("scoring held-out recordings", 1, 1)
    composer = ContactComposer(said, when, seed)
    return composer, _patch(said, composer)


def _believed(problem: Problem) -> tuple[Pair, bool]:
    """The believed model on fitted and held-out windows, under an integration that converges if that matters."""
    study = problem.simulator.study
    fitted, held = study.recordings, study.holdout
    if not held and len(fitted) > 1:
        held = fitted[EVERY - 1 :: EVERY] or fitted[-1:]
        fitted = tuple(r for r in fitted if r not in held)
    windows = make_windows(problem).on(fitted)
    if not np.isfinite(windows.predicted(np.zeros(windows.problem.size))).any():
        raise SimulationDiverged(f"{study.model_path}: the simulation diverges from every recorded start")
    fit = settled(windows)
    windows = replace(windows, heard=telling(fit))
    fit, fine = converged(settled(windows.with_problem(fit.problem), fit.z))
    timestep, integrator = fit.problem.timestep, fit.problem.integrator
    others = windows.with_problem(fit.problem).on(held if held else fitted[:1])
    start = smoothed(others, fit.problem.carry(fit.z, others.problem))
    found = Pair(fit, held_out(fit, start))
    if fine and timestep is not None and integrator is not None:
        found = shifted(found, timestep, integrator)
    return found, fine


def _patch(said: Verdict, composer: ContactComposer) -> Patch:
    """The corrected simulator at the most likely psi and effects."""
    fit: WindowFit = said.shown.fit
    study = composer.study
    means = fit.problem.psi(fit.z).tolist()
    psi = dict(zip((p.name for p in study.parameters), means, strict=True))
    values = fit.problem.effect_values(fit.z[None])
    effects = [(e, {k: v[0] for k, v in p.items()}) for e, p in zip(fit.problem.effects, values, strict=True)]
    return make_patch(study, psi, effects)
