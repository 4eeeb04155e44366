"""The diagnosis of a study in which bodies touch."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from det2stoc_bayes.engines.contacts import share_in_contact
from det2stoc_bayes.errors import SimulationDiverged
from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact.believed import believed, finer
from det2stoc_bayes.mismatch.contact.compose import ContactComposer
from det2stoc_bayes.mismatch.contact.ends import NUM_ENDS, no_surer_than_ends
from det2stoc_bayes.mismatch.contact.fit import ContactFit, fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.judge import Verdict, classes, judged, surely_little, topped_pair
from det2stoc_bayes.mismatch.contact.pair import SKETCH, Pair, paired, with_memory
from det2stoc_bayes.mismatch.contact.places import conditions, elements_of
from det2stoc_bayes.mismatch.contact.search import MAX_EFFECTS, Progress, Round, look
from det2stoc_bayes.mismatch.contact.top import widened
from det2stoc_bayes.mismatch.contact.unlisted import with_curves
from det2stoc_bayes.mismatch.contact.yardstick import SURELY, Yardstick, yardstick
from det2stoc_bayes.mismatch.finding import SURE
from det2stoc_bayes.mismatch.patch import Patch, make_patch
from det2stoc_bayes.mismatch.shares import NEGLIGIBLE
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.segments import cut

TOUCHES = 0.02  # share of states in contact from which a study is one with contact
SHORT = 20  # samples of the predictions in which that is looked at
EVERY = 4  # without held-out recordings, of how many one is not fitted


def touches(problem: Problem) -> bool:
    """Whether bodies touch often enough for derivatives to fail."""
    short = cut(problem.segments.recordings, SHORT, problem.segments.columns)
    return share_in_contact(problem.on(short)) >= TOUCHES


def diagnosed(problem: Problem, seed: int, progress: Progress) -> tuple[ContactComposer, Patch]:
    """What is to be written of a study, and the corrected simulator."""
    progress("fitting the believed model", 0, 1)
    first = fit_believed(problem)
    progress("fitting the believed model", 1, 1)
    # Of a lone recording nothing is held out, and nothing can be proven.
    lone = len(problem.simulator.study.recordings) == 1 and not problem.simulator.study.holdout
    pool = [] if lone else candidates(first.fit.problem, elements_of(first.fit))
    base, rounds = first, []
    rod: Yardstick | None = None  # of the base, where that is at its top

    @cache
    def top_of(pair: Pair) -> tuple[Pair, Yardstick]:
        progress("measuring what is left", 0, 1)
        top = _measured(_by_steps_that_tell(pair), seed)
        progress("measuring what is left", 1, 1)
        return top

    by_steps_of = cache(_by_steps_of)

    def little(believed: Pair, taken: Pair) -> bool:
        final, scale = top_of(taken)
        return surely_little(by_steps_of(final, believed), final, scale)

    def matters(believed: Pair, taken: Pair, near: Sequence[Pair]) -> bool:
        if rounds or not little(believed, taken):
            return True
        _, scale = top_of(taken)
        memory = taken.fit.followed.memory
        plain, others = with_memory(believed, memory), (with_memory(p, memory) for p in near if p is not taken)
        return any(scale.most_gained(plain, other) >= NEGLIGIBLE for other in others)

    while len(rounds) < MAX_EFFECTS:
        one = look(base, pool, progress, seed, matters) if pool else Round(base, (), (), None)
        rounds.append(one)
        if one.taken is None:
            rod = rod if one.base is base else None
            base = one.base
            break
        base, rod = top_of(one.taken)
        if one.rivals and classes(one, np.random.default_rng(seed))[0].chance < SURE:
            break  # what else is missing depends on which of them it is
        first_is_little = len(rounds) == 1 and one.leader is None and little(one.base, one.taken)
        if first_is_little or _settled(rounds[0].base, base, rod):
            break
    if _may_be_another_shape(rounds, base, rod):
        listed, rounds = rounds[0].taken, with_curves(rounds, base, pool, by_steps_of, progress)
        if rounds[0].taken is not listed:
            base, rod = top_of(rounds[0].taken)
    progress("scoring held-out recordings", 0, 1)
    before = by_steps_of(base, rounds[0].base)
    if rod is None:
        alone = base is rounds[0].base
        base, rod = _measured(base, seed)
        if alone:  # beyond its bumps psi may be led astray: where it was found before is as likely
            before = base = replace(base, fit=widened(base.fit, first.fit.z))
    said = judged(before, rounds, seed, base, rod)
    if said.verdict != "inconclusive":
        said = _no_surer_than_ends(said, rounds, seed, progress)
    when = conditions(said.before, said.after) if said.verdict == "mismatch" else []
    composer = ContactComposer(said, when, seed)
    progress("scoring held-out recordings", 1, 1)
    return composer, _patch(said, composer)


def _no_surer_than_ends(said: Verdict, rounds: Sequence[Round], seed: int, progress: Progress) -> Verdict:
    """The same, told of its unknowns no surer than by where fits end that begin about it."""
    luck, tell = max(r.luck for r in rounds), partial(progress, "fitting from elsewhere")
    fit = no_surer_than_ends(said.shown.fit, luck, np.random.default_rng([seed, 17]), lambda k: tell(k, NUM_ENDS))
    tell(1, 1)
    told = replace(said.shown, fit=fit)
    return replace(said, after=told) if said.verdict == "mismatch" else replace(said, before=told, after=told)


def _by_steps_that_tell(pair: Pair) -> Pair:
    """The same by shorter steps, where these tell better: what was missing may have hidden it."""
    fit = finer(pair.fit)
    return pair if fit is pair.fit else paired(fit, pair.held.followed)


def _by_steps_of(other: Pair, pair: Pair) -> Pair:
    """The same by the steps of another, which it is held against."""
    step = other.fit.problem.timestep
    if step == pair.fit.problem.timestep:
        return pair
    followed = pair.fit.followed.integrated(step, None)
    return paired(fit_followed(followed, pair.fit.z, iterations=SKETCH, like=pair.fit), pair.held.followed)


def _measured(pair: Pair, seed: int) -> tuple[Pair, Yardstick]:
    """A hypothesis at its top, and what errors it would leave."""
    top = topped_pair(pair, seed)
    return top, yardstick(top.fit, seed)


def _settled(before: Pair, after: Pair, rod: Yardstick) -> bool:
    """Whether surely so little of the error is left that whatever else explains it were negligible."""
    most = rod.of(after) + SURELY * rod.uncertain(after)
    return rod.left(rod.of(with_memory(before, after.fit.followed.memory)), most) < NEGLIGIBLE


def _may_be_another_shape(rounds: Sequence[Round], after: Pair, rod: Yardstick | None) -> bool:
    """Whether several were taken, or what was taken leaves more than next to nothing; `rod`: of `after`, if known."""
    taken = [r for r in rounds if r.taken is not None]
    return bool(taken) and (len(taken) > 1 or rod is None or not _settled(rounds[0].base, after, rod))


def fit_believed(problem: Problem, *, hold_out: bool = True) -> Pair:
    """The believed model on fitted and held-out recordings.

    Without `holdout` some recordings are held out, if that is wanted; a lone one stands for both. Raises
    SimulationDiverged.
    """
    study = problem.simulator.study
    fitted, held = study.recordings, study.holdout
    if hold_out and not held and len(fitted) > 1:
        held = fitted[EVERY - 1 :: EVERY] or fitted[-1:]
        fitted = tuple(r for r in fitted if r not in held)
    whole = Followed(problem)
    followed = whole.on(fitted)
    if not np.isfinite(followed.path(np.zeros(problem.size)).columns).any():
        raise SimulationDiverged(
            f"{study.model_path}: the simulation diverges from every recorded start; allowed: one that stays "
            "finite (check units, the timestep and the recordings' first samples)"
        )
    return believed(followed, whole.on(held if held else fitted[:1]))


def _patch(said: Verdict, composer: ContactComposer) -> Patch:
    """The corrected simulator at the most likely psi and effects."""
    fit: ContactFit = said.shown.fit
    study = composer.study
    means = fit.problem.psi(fit.z).tolist()
    psi = dict(zip((p.name for p in study.parameters), means, strict=True))
    values = fit.problem.effect_values(fit.z[None])
    effects = [(e, {k: v[0] for k, v in p.items()}) for e, p in zip(fit.problem.effects, values, strict=True)]
    problem = fit.problem
    return make_patch(study, psi, effects, timestep=problem.timestep, integrator=problem.integrator)
