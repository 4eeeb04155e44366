"""How looks for additions follow each other where bodies touch, and where they end."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, XML, slides

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact import run
from det2stoc_bayes.mismatch.contact.fit import at
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.judge import Verdict
from det2stoc_bayes.mismatch.contact.pair import Pair
from det2stoc_bayes.mismatch.contact.scales import Scales
from det2stoc_bayes.mismatch.contact.search import Round
from det2stoc_bayes.mismatch.contact.yardstick import Yardstick
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator


class Judged(Exception):
    """The rounds are over."""


@pytest.mark.parametrize(
    ("little", "other_gains", "replaced", "num_looks"),
    [(False, 0.0, False, 3), (True, 0.0, False, 1), (True, 0.2, False, 1), (True, 0.0, True, 3)],
)
def test_a_first_addition_that_surely_takes_little_off_ends_it(
    tmp_path, monkeypatch, little, other_gains, replaced, num_looks
):
    """And has no rivals, unless who is near it takes more off; if it took a leader's place the looks go on."""
    problem = make_problem(Simulator(make_study(tmp_path / "study", XML.format(0.02), PSI, slides()), num_threads=1))
    few = Followed(problem).on(problem.simulator.study.recordings[:1])
    placed = candidates(problem)[:1]

    def pair() -> Pair:
        fit = at(few.with_problem(few.problem.with_effects(tuple(placed))), np.zeros(1 + placed[0].size))
        return Pair(fit, fit)

    base, taken, other = at(few, np.zeros(1)), pair(), pair()
    base = Pair(base, base)
    rod = Yardstick((), Scales(np.ones(few.shape[-1])), 1.0, 0)
    asked, ends = [], []

    def look(before, pool, progress, seed, matters):
        asked.append(matters(before, taken, [taken, other]))
        return Round(before, (), (taken,), taken, leader=other if replaced else None)

    def judged(before, rounds, *_):
        ends.append(rounds)
        raise Judged

    monkeypatch.setattr(run, "fit_believed", lambda _: base)
    monkeypatch.setattr(run, "look", look)
    monkeypatch.setattr(run, "judged", judged)
    monkeypatch.setattr(run, "_by_steps_that_tell", lambda p: p)
    monkeypatch.setattr(run, "_by_steps_of", lambda _, p: p)
    monkeypatch.setattr(run, "_measured", lambda p, _: (p, rod))
    monkeypatch.setattr(run, "_settled", lambda *_: False)
    monkeypatch.setattr(run, "with_memory", lambda p, _: p)
    monkeypatch.setattr(run, "surely_little", lambda *_: little)
    monkeypatch.setattr(Yardstick, "most_gained", lambda *_: other_gains)
    with pytest.raises(Judged):
        run.diagnosed(problem, 0, lambda *_: None)
    assert len(asked) == len(ends[0]) == num_looks
    assert asked[0] is (not little or other_gains > 0) and all(asked[1:])


@pytest.mark.parametrize(
    ("num_taken", "settled", "is_asked"), [(0, False, False), (1, True, False), (1, False, True), (2, True, True)]
)
def test_a_curve_is_looked_for_where_more_is_left_or_several_were_taken(
    tmp_path, monkeypatch, num_taken, settled, is_asked
):
    """And where it is taken it is what the verdict is of."""
    problem = make_problem(Simulator(make_study(tmp_path / "study", XML.format(0.02), PSI, slides()), num_threads=1))
    few = Followed(problem).on(problem.simulator.study.recordings[:1])
    base, taken, curve = (Pair(fit, fit) for fit in (at(few, np.zeros(1)) for _ in range(3)))
    rod = Yardstick((), Scales(np.ones(few.shape[-1])), 1.0, 0)
    looks = iter([Round(base, (), (), taken)] * num_taken + [Round(base, (), (), None)])
    ends = iter([False] * (num_taken - 1) + [settled] * 2)
    asked, told = [], []

    def with_curves(rounds, after, pool, by_steps_of, progress):
        asked.append(after)
        return [replace(rounds[0], taken=curve)]

    def judged(before, rounds, seed, final, rod):
        told.append((rounds, final))
        raise Judged

    monkeypatch.setattr(run, "fit_believed", lambda _: base)
    monkeypatch.setattr(run, "look", lambda *_: next(looks))
    monkeypatch.setattr(run, "with_curves", with_curves)
    monkeypatch.setattr(run, "judged", judged)
    monkeypatch.setattr(run, "_by_steps_that_tell", lambda p: p)
    monkeypatch.setattr(run, "_by_steps_of", lambda _, p: p)
    monkeypatch.setattr(run, "_measured", lambda p, _: (p, rod))
    monkeypatch.setattr(run, "_settled", lambda *_: next(ends))
    monkeypatch.setattr(run, "surely_little", lambda *_: False)
    monkeypatch.setattr(run, "widened", lambda fit, *_: fit)
    with pytest.raises(Judged):
        run.diagnosed(problem, 0, lambda *_: None)
    ((rounds, final),) = told
    assert bool(asked) is is_asked and (rounds[0].taken is curve) is is_asked
    assert (final is curve) is is_asked


@pytest.mark.parametrize("verdict", ["mismatch", "no_mismatch", "inconclusive"])
def test_what_is_told_is_no_surer_than_fits_that_begin_about_it(tmp_path, monkeypatch, verdict):
    """Of the explanation, or where nothing is missing of the believed model, which then stands for both.

    Where nothing is told, what is shown is a model that is known to be wrong: nothing is asked of it.
    """
    problem = make_problem(Simulator(make_study(tmp_path / "study", XML.format(0.02), PSI, slides()), num_threads=1))
    fits = [at(Followed(problem).on(problem.simulator.study.recordings[:1]), np.full(1, z)) for z in (0.0, 0.1)]
    before, after = (Pair(f, f) for f in (fits[:1] * 2 if verdict == "no_mismatch" else fits))
    rod = Yardstick((), Scales(np.ones(13)), 1.0, 0)
    told = []

    def composed(said, *_):
        told.append(said)
        raise Judged

    monkeypatch.setattr(run, "fit_believed", lambda _: before)
    monkeypatch.setattr(run, "candidates", lambda *_: [])
    monkeypatch.setattr(run, "_measured", lambda p, _: (p, rod))
    monkeypatch.setattr(run, "judged", lambda *_: Verdict(verdict, before, after, (), (), 0.0, 0.0, rod, ()))
    monkeypatch.setattr(run, "no_surer_than_ends", lambda f, *_: replace(f, rough=np.ones((1, 1))))
    monkeypatch.setattr(run, "conditions", lambda *_: [])
    monkeypatch.setattr(run, "ContactComposer", composed)
    with pytest.raises(Judged):
        run.diagnosed(problem, 0, lambda *_: None)
    (said,) = told
    assert (said.shown.fit.rough is None) is (verdict == "inconclusive")
    np.testing.assert_array_equal(said.shown.fit.z, (after if verdict == "mismatch" else before).fit.z)
    assert (said.before is before) is (verdict != "no_mismatch") and said.shown in (said.before, said.after)
