"""Forces on no list: evidence in closed form, the variable that is told, listed effects that keep their names."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import dense_evidence, fit, place, spring_problem

from det2stoc_bayes.mismatch import unlisted as module
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.effects.unlisted import OverPosition, UnlistedForce, interpolated, leading, matern
from det2stoc_bayes.mismatch.evidence import by_chance
from det2stoc_bayes.mismatch.explain import Explanation
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.race import Ranked
from det2stoc_bayes.mismatch.unlisted import explain_by_all
from det2stoc_bayes.mismatch.unlisted_screen import screen_unlisted

TYPICAL = Typical(force=3.0, speed=1.0, span=0.3, inertia=1.2)
NAMES = ("quadratic_damping", "viscous_damping", "coulomb_friction", "constant_force", "cubic_stiffness")


def pool_of(problem):
    return [place(problem, name, "slide", TYPICAL) for name in NAMES]


def pushed(law):
    """A force on the block of this position, speed and time."""

    def push(model, data):
        data.qfrc_applied[0] = law(data.qpos[0], data.qvel[0], data.time)

    return push


def knock(q, v, t):
    return 2.0 * np.exp(-(((t - 0.3) / 0.08) ** 2))


LAWS = {
    "position": lambda q, v, t: 1.5 * np.exp(-(((q - 0.1) / 0.05) ** 2)),
    "velocity": lambda q, v, t: -1.5 * np.exp(-(((v - 0.6) / 0.25) ** 2)),
    "time": knock,
}


def test_evidence_is_that_of_a_dense_regression(tmp_path):
    """A mass on a spring is linear in a force of time, so that both are exact; the noise is told large: s2 = 1."""
    problem = spring_problem(tmp_path, push=pushed(lambda q, v, t: 0.05 * knock(q, v, t)), noise=0.01)
    problem = type(problem)(problem.simulator, problem.segments, 1.3 * problem.noise, problem.guess)
    base = fit(problem, tolerance=1e-4, free_scale=False)
    found = next(s for s in screen_unlisted(base, pool_of(problem), 1) if s.placed.effect.variables == ("time",))
    z, start = base.point.z, base.point.start
    plain = problem.simulator.rollout(problem.request(z[None], start))
    with_one, columns = problem.with_effects([found.placed]), []
    for values in found.trial.columns:
        own = np.concatenate([z, found.placed.effect.to_normal(values, TYPICAL)])
        moved = with_one.simulator.rollout(with_one.request(own[None], start))
        columns.append((moved - plain).reshape(len(moved), -1))
    expected = dense_evidence(problem, z, start, np.stack(columns, -1)) - dense_evidence(problem, z, start)
    assert base.noise_scale == 1.0
    assert found.log_evidence == pytest.approx(expected, abs=0.05 + 0.01 * abs(expected))


@pytest.mark.parametrize("variable", LAWS)
def test_the_variable_is_told(tmp_path, variable):
    base = fit(spring_problem(tmp_path, push=pushed(LAWS[variable]), noise=1e-3))
    first, second, *_ = screen_unlisted(base, pool_of(base.problem), 1)
    assert first.placed.effect.variables == (variable,)
    assert first.log_evidence > second.log_evidence + 20  # nats


def test_a_curve_that_listed_effects_leave_is_found(tmp_path):
    base = fit(spring_problem(tmp_path, push=pushed(LAWS["position"]), noise=1e-3))
    found = explain_by_all(base, pool_of(base.problem), Looks())
    (placed,) = found.after.problem.effects
    assert isinstance(placed.effect, UnlistedForce) and placed.effect.variables == ("position",)
    assert by_chance(found.after)
    values = {n: v[0] for n, v in found.after.problem.effect_values(found.after.point.z[None])[0].items()}
    x = np.linspace(values["least"], values["most"], len(values["curve"]))
    truth = np.array([LAWS["position"](q, 0, 0) for q in x])
    # What psi takes up, a slope, is not asked for; where the curve ends is seen least.
    line = np.stack([np.ones_like(x), x], -1)
    off, size = (y - line @ np.linalg.lstsq(line, y, rcond=None)[0] for y in (values["curve"] - truth, truth))
    assert np.linalg.norm(off) < 0.4 * np.linalg.norm(size)  # measured: 0.27


def test_a_listed_effect_keeps_its_name(tmp_path):
    base = fit(spring_problem(tmp_path, push=pushed(lambda q, v, t: -0.5 * abs(v) * v), noise=1e-3))
    found = explain_by_all(base, pool_of(base.problem), Looks())
    assert [e.effect.name for e in found.after.problem.effects] == ["quadratic_damping"]


def test_nothing_is_found_where_nothing_is_left_out(tmp_path):
    base = fit(spring_problem(tmp_path, noise=1e-3))
    assert explain_by_all(base, pool_of(base.problem), Looks()).after is base


def test_curves_beside_a_fit_are_fitted_once(tmp_path, monkeypatch):
    """Whatever they have to promise, while it is the same ones that do."""
    base, real, raced = fit(spring_problem(tmp_path, push=pushed(LAWS["position"]), noise=1e-3)), module.race, []
    monkeypatch.setattr(module, "race", lambda *given: raced.append(given) or real(*given))
    pool, looks = pool_of(base.problem), Looks(lambda *_: None)
    first, again = (module._beside(base, pool, 1, least, looks) for least in (10.0, 11.0))
    assert again is first and len(raced) == 1 and first.ranked


def test_a_curve_that_is_far_over_short_stretches_is_not_fitted_to_long_ones(tmp_path, monkeypatch):
    base = fit(spring_problem(tmp_path, push=pushed(LAWS["position"]), noise=1e-4))
    listed = fit(base.problem.with_effects([place(base.problem, NAMES[0], "slide", TYPICAL)]))
    longer, asked = replace(base), []  # the same believed model, refitted
    found = Explanation(longer, listed, (), 1, 1.0)
    for inflation, bases in ((1.1 * module.FAR, [base, base]), (0.9 * module.FAR, [base, longer, base, longer])):
        curve = replace(listed, chi2=listed.chi2 * inflation / listed.noise_inflation)
        curves = module._Curves([], [Ranked(curve.problem.effects[0], curve, 9.0)])
        asked.clear()
        monkeypatch.setattr(module, "_beside", lambda at, *_, curves=curves: asked.append(at) or curves)
        monkeypatch.setattr(module, "_completed", lambda fit, *_: fit)
        monkeypatch.setattr(module, "_clearly", lambda *_: False)
        assert module.beyond_list(base, found, (), Looks(lambda *_: None)) is found
        assert [id(f) for f in asked] == [id(f) for f in bases]


def test_beside_a_curve_that_is_worse_than_what_is_bad_nothing_is_looked_for(tmp_path, monkeypatch):
    """Where both are far from the recordings; a curve that tells others better is completed."""
    base = fit(spring_problem(tmp_path, push=pushed(LAWS["position"]), noise=1e-4))
    listed, curve = (
        fit(base.problem.with_effects([place(base.problem, name, "slide", TYPICAL)])) for name in NAMES[:2]
    )
    assert min(listed.noise_inflation, curve.noise_inflation) > module.FAR
    monkeypatch.setattr(
        module, "_beside", lambda *_: module._Curves([], [Ranked(curve.problem.effects[0], curve, 9.0)])
    )
    completed = []
    monkeypatch.setattr(module, "_completed", lambda fit, *_: completed.append(fit) or fit)
    monkeypatch.setattr(module, "_clearly", lambda *_: False)
    found = Explanation(base, listed, (), 1, 1.0)
    for told, times in (({id(listed): 2.0, id(curve): 3.0}, 0), ({id(listed): 3.0, id(curve): 2.0}, 2)):
        monkeypatch.setattr(module, "untold", lambda f, told=told: told[id(f)])
        completed.clear()
        assert module.beyond_list(base, found, (), Looks(lambda *_: None)) is found and len(completed) == times


def test_after_a_long_search_nothing_is_looked_for_beside_a_curve(tmp_path, monkeypatch):
    """How long it was is counted in steps of the first look."""
    base = fit(spring_problem(tmp_path, push=pushed(LAWS["position"]), noise=1e-4))
    pool, looks = pool_of(base.problem), Looks(lambda *_: None)
    listed, curve = (fit(base.problem.with_effects([p])) for p in pool[:2])
    assert looks.spent(base) == 0.0
    looks.at(base, pool)
    assert looks.spent(base) == 1.0
    looks.at(listed, pool)
    spent = looks.spent(base)
    assert spent > 1.1  # measured: 2.2
    found, grown = Explanation(base, listed, (), 1, 1.0), []
    monkeypatch.setattr(module, "grow", lambda slot, *_: grown.append(slot) or (listed, {}))
    for most, times in ((0.9 * spent, 0), (1.1 * spent, 1)):
        monkeypatch.setattr(module, "MOST_SPENT", most)
        grown.clear()
        assert module._completed(curve, found, 9.0, looks) is (listed if times else curve)
        assert len(grown) == times


def test_a_curve_goes_through_its_knots_and_bends_as_told():
    knots = np.linspace(-1.0, 2.0, 65)
    at, shares = interpolated(knots, -1.0, 2.0, 65, np)
    np.testing.assert_allclose((shares * knots[at]).sum(-1), knots, atol=1e-12)
    x = np.linspace(-1.0, 2.0, 300)
    at, shares = interpolated(x, -1.0, 2.0, 65, np)
    off = np.abs((shares * np.sin(4 * knots)[at]).sum(-1) - np.sin(4 * x))
    assert off[5:-5].max() < 5e-4 and off.max() < 0.01  # measured: 2e-4, and 0.008 beside the last knots
    at, shares = interpolated(np.array([-9.0, 9.0]), -1.0, 2.0, 65, np)
    np.testing.assert_allclose((shares * knots[at]).sum(-1), [-1.0, 2.0], atol=1e-12)  # stays as it ends
    modes = leading((65,), (0.16,))
    kernel = matern(np.linspace(0, 1, 65), 0.16)
    assert np.trace(modes @ modes.T) == pytest.approx(np.trace(kernel), rel=0.005)
    assert OverPosition().size == modes.shape[1]
