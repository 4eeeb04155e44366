"""A correction that spoils what it does not mend names nothing."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import fit, place, spring_problem

from det2stoc_bayes.mismatch import judgement
from det2stoc_bayes.mismatch.explain import Explanation
from det2stoc_bayes.mismatch.heldout import held_out
from det2stoc_bayes.mismatch.judgement import SPOILT, _spoils
from det2stoc_bayes.mismatch.numerics import Numerics
from det2stoc_bayes.mismatch.race import Ranked, Slot
from det2stoc_bayes.segments import cut


@pytest.mark.parametrize(
    ("inflation", "worse", "spoilt"), [(50, 2 * SPOILT, True), (50, 0.5 * SPOILT, False), (1.2, 2 * SPOILT, False)]
)
def test_a_column_told_worse_beside_a_misfit_that_stays(tmp_path, inflation, worse, spoilt):
    base = fit(spring_problem(tmp_path, noise=1e-3))
    scores = held_out(base)
    growth = np.array([0.5, (1 + worse) ** 2])  # one column gains, the other loses
    later = replace(scores, squared_error=scores.squared_error * growth)
    left = replace(base, chi2=inflation * base.linear.degrees_of_freedom)
    assert _spoils(left, scores, later) is spoilt
    assert not _spoils(left, scores, scores)


def test_two_effects_that_explain_nothing_together_are_not_named(tmp_path, monkeypatch):
    """Without either the other makes it worse: beside the believed model both are in vain."""
    base = fit(spring_problem(tmp_path, noise=1e-3))
    a, b = (place(base.problem, name, "slide") for name in ("constant_force", "quadratic_damping"))
    alone = {e: fit(base.problem.with_effects([e])) for e in (a, b)}
    both = replace(fit(base.problem.with_effects([a, b])), chi2=50 * base.linear.degrees_of_freedom)
    scores = held_out(base)
    error = {0: 100.0, 1: 300.0, 2: 99.0}  # times the number of values, by the number of effects

    def told(fitted, *_):
        return replace(scores, chi2=error[len(fitted.problem.effects)] * scores.num_values)

    monkeypatch.setattr(judgement, "held_out", told)
    slots = tuple(Slot(alone[o], (), (Ranked(e, both, 100.0),)) for e, o in ((a, b), (b, a)))
    found = Explanation(base, both, slots, 10, 1.0)
    judged = judgement.judge(base, found, None)
    assert judged.verdict == "no_mismatch" and judged.after is base
    assert [p for p, _ in judged.negligible] == [a, b]
    error[2] = 10.0
    assert judgement.judge(base, found, None).verdict == "mismatch"


@pytest.mark.parametrize(("misfit", "verdict"), [(1.5, "mismatch"), (1.04, "no_mismatch"), (0.98, "no_mismatch")])
def test_an_error_of_integration_that_is_nothing_beside_noise_is_not_named(tmp_path, monkeypatch, misfit, verdict):
    """Whatever its evidence: it takes all of the excess off, which is half the noise's square, or a 25th, or adds."""
    base = fit(spring_problem(tmp_path, noise=1e-3))
    finer = fit(replace(base.problem, timestep=1e-3, integrator="RK4"))
    scores = held_out(base)
    count = scores.num_values * 1e5 / scores.num_values.sum()  # so many that either is beyond chance

    def told(fitted, *_):
        coarse = fitted.problem.timestep is None and fitted.problem.finer is None
        error = misfit if coarse else 1.0
        return replace(scores, num_values=count, chi2=error * count)

    monkeypatch.setattr(judgement, "held_out", told)
    judged = judgement.judge(base, Explanation(finer, finer, (), 10, 1.0), Numerics(1e-3, "RK4", 100.0, finer))
    assert judged.verdict == verdict and (judged.numerics is None) == (verdict == "no_mismatch")
    assert judged.numerics_share == float(misfit > 1)
    # The believed model is told without that error, which psi would make up for.
    held = judged.before.problem.finer is not None
    assert held == (misfit == 1.04)  # unless other recordings are told worse so
    assert not held or (judged.held_after.chi2 == count).all()


def test_an_error_of_integration_is_sized_over_the_stretches_of_what_is_told(tmp_path, monkeypatch):
    """Short stretches, whose starts absorb what is missing, would give the steps the merit of the effect."""
    base = fit(spring_problem(tmp_path, noise=1e-3))
    placed = place(base.problem, "quadratic_damping", "slide")
    after = fit(replace(base.problem.with_effects([placed]), timestep=1e-3, integrator="RK4"))
    cut_short = base.problem.on(cut(base.problem.segments.recordings, 10, base.problem.segments.columns))
    finer = fit(replace(cut_short, timestep=1e-3, integrator="RK4"))
    scores = held_out(base)

    def told(fitted, *_):
        here = fitted.problem.segments.extent == base.problem.segments.extent
        return replace(scores, chi2=(100.0 if here and not fitted.problem.effects else 1.0) * scores.num_values)

    monkeypatch.setattr(judgement, "held_out", told)
    monkeypatch.setattr(judgement, "extend", lambda f, far: f)
    found = Explanation(base, after, (Slot(base, (), (Ranked(placed, after, 100.0),)),), 10, 1.0)
    judged = judgement.judge(base, found, Numerics(1e-3, "RK4", 100.0, finer))
    assert judged.numerics is None and judged.numerics_share == 0.0
    assert [n.placed for n in judged.named] == [placed] and judged.after.problem.finer is not None
