"""Rivals where simulations rattle: weighed by how far one leads the other on recordings that each of them makes."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, SLIDING, TRUTH, XML, slides

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact import judge, rattle, replicas
from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.pair import Pair
from det2stoc_bayes.mismatch.contact.replicas import moved_freely
from det2stoc_bayes.mismatch.contact.screen import Promise
from det2stoc_bayes.mismatch.contact.search import Round
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    study = make_study(tmp_path_factory.mktemp("slides") / "study", XML.format(0.02), PSI, slides())
    problem = make_problem(Simulator(study, num_threads=1))
    return Followed(problem, 12.0).hearing(np.isin(problem.segments.columns, SLIDING))


@pytest.fixture(scope="module")
def pool(followed):
    return {c.effect.name: c for c in candidates(followed.problem)}


def told(followed, placed, value) -> ContactFit:
    """An effect of this size beside the true friction."""
    problem = followed.problem.with_effects((placed,))
    friction = float(problem.simulator.parameters[0].prior.to_normal(TRUTH))
    return at(followed.with_problem(problem), np.array([friction, value]))


def test_what_moves_freely_goes_on_from_its_start_with_the_measurements_noise(followed, pool):
    fit = told(followed, pool["linear_drag"], 0.3)
    made = moved_freely(fit, np.random.default_rng(0)).problem.segments.values
    problem = fit.problem
    moved = problem.simulator.rollout(problem.request(fit.z[None], followed.start))
    assert (made[:, 0] == problem.segments.values[:, 0]).all()
    left = (made[:, 1:] - moved[:, 1:]) / problem.noise
    assert abs(left.std() - 1) < 0.06 and abs(left.mean()) < 0.08  # 4 standard errors of 1560 values


@pytest.mark.parametrize("first_made_them", [True, False])
def test_odds_are_for_what_made_the_recordings_whoever_leads(followed, pool, first_made_them):
    drag, weight = (told(followed, pool[n], z) for n, z in (("linear_drag", 2.0), ("gravity_error", -1.0)))
    made = moved_freely(drag if first_made_them else weight, np.random.default_rng(1))
    first, second = (
        fit_followed(made.with_problem(made.problem.with_effects(f.problem.effects)), f.z) for f in (drag, weight)
    )
    own, others = (rattle.made_by(fit, 0) for fit in (first, second))
    one, other = rattle.log_odds(first, second, own, others, 2.0), rattle.log_odds(second, first, others, own, 2.0)
    assert one == pytest.approx(-other, abs=1e-6)
    assert (one < -2) == first_made_them and (one > 2) != first_made_them


def test_who_promises_half_as_much_with_no_more_parameters_is_a_rival(followed, pool, monkeypatch):
    leader = told(followed, pool["linear_drag"], 0.3)
    own = at(followed, leader.z[:1])
    pair, other = (Pair(told(followed, pool[n], 0.1), own) for n in ("linear_drag", "buoyancy"))
    promise, fitted = partial(Promise, values={}, change=np.zeros(1)), []
    gains = {"linear_drag": 100.0, "rotating_frame": 90.0, "buoyancy": 80.0, "gravity_error": 60.0, "sensor_bias": 49.0}
    screened = [promise(pool[name], gain) for name, gain in gains.items()]
    monkeypatch.setattr(rattle, "sketched", lambda led, s: s)
    monkeypatch.setattr(rattle, "finished", lambda s, *_: fitted.append(s) or Pair(told(followed, s.placed, 0.2), own))
    monkeypatch.setattr(rattle, "log_odds", lambda *_: -1.0)
    monkeypatch.setattr(rattle, "made_by", lambda *_: [])
    monkeypatch.setattr(rattle, "as_the_best", lambda pairs, _: pairs)
    assert pool["rotating_frame"].size > pool["linear_drag"].size == pool["sensor_bias"].size

    def names(screened, known=()):
        found = rattle.rivals(pair, known, own, screened, 2.0, 0, lambda *_: None)
        return [r.pair.placed.effect.name for r in found]

    assert names(screened) == ["buoyancy", "gravity_error"] and len(fitted) == 2
    assert names(screened, [pair, other]) == ["buoyancy", "gravity_error"] and len(fitted) == 3
    assert names(screened[1:]) == ["buoyancy", "gravity_error", "sensor_bias"]  # beside the most that was promised
    assert names([]) == [] == names(screened[:2])
    monkeypatch.setattr(rattle, "MOST_RIVALS", 1)
    assert names(screened) == ["buoyancy"]
    monkeypatch.setattr(rattle, "alike", lambda *_: True)
    assert names(screened) == []


def test_who_is_surely_likelier_takes_the_leaders_place(followed, pool, monkeypatch):
    base = at(followed, np.zeros(1))
    leader, near, far = (Pair(told(followed, pool[n], 0.1), base) for n in ("linear_drag", "buoyancy", "gravity_error"))
    unsure = (rattle.Rival(near, 1.0), rattle.Rival(far, -3.0))
    assert rattle.likelier(unsure) is None and rattle.likelier(()) is None
    sure = (rattle.Rival(near, 2.0), rattle.Rival(far, -3.0))
    assert rattle.likelier(sure) is near
    between = Pair(told(followed, pool["sensor_bias"], 0.1), base)  # by height, and never weighed
    monkeypatch.setattr(judge, "chances", lambda told, *_: np.array([float(p is leader) for p in told]))
    one = Round(Pair(base, base), (), (leader, between, near, far), near, 2.0, sure, leader)
    ranked = judge.classes(one, np.random.default_rng(0))
    odds = np.exp([2.0, 0.0, -3.0])
    assert [c.members for c in ranked] == [(near,), (leader,), (far,), (between,)]
    np.testing.assert_allclose([c.chance for c in ranked[:3]], odds / odds.sum(), atol=1e-6)


def test_simulations_rattle_where_a_column_has_no_say(followed):
    assert rattle.rattles(at(followed, np.zeros(1)))
    assert not rattle.rattles(at(followed.hearing(np.ones(13, bool)), np.zeros(1)))
    assert not rattle.rattles(at(replace(followed, heard=None), np.zeros(1)))


def test_a_lead_that_a_rivals_own_recordings_give_is_no_proof(followed, pool, monkeypatch):
    """A puck's less friction led its buoyancy by 101 nats; so it did on what either made."""
    leader, rival = (told(followed, pool[n], 0.1) for n in ("linear_drag", "gravity_error"))
    own, others = (rattle.made_by(fit, 0) for fit in (leader, rival))
    leads = dict(zip([id(m.problem) for m in (*own, *others)], [162.0, 131.0, 198.0, 50.0, 110.0, 55.0], strict=True))

    asked = []

    def odds_at(observed):
        del asked[:]

        def behind(fit, followed, luck):
            asked.append(fit is rival)
            return SimpleNamespace(loss=leads.get(id(followed.problem), observed) if fit is rival else 0.0)

        monkeypatch.setattr(rattle, "refitted", behind)
        return rattle.log_odds(leader, rival, own, others, 6.0)

    assert 0.7 < odds_at(101.3) < 1.1  # for the rival
    assert odds_at(118.0) == pytest.approx(0.0, abs=0.15)  # halfway between
    assert odds_at(190.0) < -2 and odds_at(40.0) > 2 and sum(asked) == 1 + 2 * rattle.NUM_MADE
    leads |= dict.fromkeys(list(leads)[:3], 1000.0)
    assert odds_at(1000.0) < -rattle.CLEAR and sum(asked) == 1 + 2 * rattle.FEW
    assert odds_at(400.0) > -rattle.CLEAR and sum(asked) == 1 + 2 * rattle.NUM_MADE


def test_where_what_nothing_leads_diverges_the_lead_alone_is_asked(followed, pool, monkeypatch):
    leader, rival = (told(followed, pool[n], 0.1) for n in ("linear_drag", "gravity_error"))

    def diverged(fit, random):
        made = moved_freely(fit, random)
        made.problem.segments.values[0, 5:] = np.nan
        return made

    own = rattle.made_by(leader, 0)
    monkeypatch.setattr(rattle, "moved_freely", diverged)
    others = rattle.made_by(rival, 0)
    assert len(own) == rattle.NUM_MADE and others == []
    leader.prepare()
    rival.prepare()
    first, second = (rattle.refitted(fit, leader.followed, 2.0).loss for fit in (leader, rival))
    assert rattle.log_odds(leader, rival, own, others, 2.0) == first - second
    known = []
    odds = rattle.log_odds(leader, rival, own, [], 2.0, lambda f: known.append(f) or rattle.refitted(leader, f, 2.0))
    assert known == [leader.followed] and odds == first - second


def test_what_is_made_alone_is_led_only_where_it_diverges(followed, pool, monkeypatch):
    leader = told(followed, pool["linear_drag"], 0.1)

    def values(make):
        return make(leader, np.random.default_rng(0)).problem.segments.values

    free, led = values(replicas.moved_freely), values(replicas.replicated)
    assert np.array_equal(values(replicas.made_alone), free, equal_nan=True)
    assert not np.allclose(free, led, equal_nan=True)
    made = replicas.moved_freely(leader, np.random.default_rng(0))
    lost = replace(made.problem.segments, values=np.full_like(free, np.nan))
    monkeypatch.setattr(replicas, "moved_freely", lambda *_: replace(made, problem=made.problem.on(lost)))
    assert np.array_equal(values(replicas.made_alone), led, equal_nan=True)
