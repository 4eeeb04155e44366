"""Curves in the place of listed laws where bodies touch: taken where no listed law has the shape, and nowhere else."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from conftest import make_study

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact import unlisted
from det2stoc_bayes.mismatch.contact.fit import at, fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.judge import classes
from det2stoc_bayes.mismatch.contact.pair import caught_up, paired
from det2stoc_bayes.mismatch.contact.places import elements_of
from det2stoc_bayes.mismatch.contact.search import Round
from det2stoc_bayes.mismatch.curves import described
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator

XML = """<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="left" type="box" pos="-0.35 0 0" size="0.05 0.2 0.2" solref="0.03 1"/>
    <geom name="right" type="box" pos="0.35 0 0" size="0.05 0.2 0.2" solref="0.03 1"/>
    <body name="carriage">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.2"/>
      <geom name="ball" type="sphere" size="0.05" mass="0.5" solref="0.03 1"/>
    </body>
  </worldbody>
</mujoco>
"""
PSI = """[psi.mass]
target = "body/carriage/mass"
prior = { TruncatedNormal = { loc = 0.5, scale = 0.05, low = 0.2, high = 0.9 } }
[noise]
"qpos/*" = 5e-4
"qvel/*" = 5e-3
"""
STIFFNESS, SIZE, STEEP = 3.0, 0.8, 40.0


def spring(q):
    """On the list."""
    return -STIFFNESS * q


def step(q):
    """On no list."""
    return -SIZE * np.tanh(STEEP * (q - 0.05))


def runs(law):
    """Six recordings of a carriage that bounces between two stops, by a quarter of the step."""
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.timestep /= 4
    random, time, out = np.random.default_rng(3), np.arange(81) * 0.01, {}
    for k in range(6):
        data = mujoco.MjData(model)
        data.qpos[0], data.qvel[0] = random.uniform(-0.2, 0.2), random.uniform(0.8, 1.6) * (-1) ** k
        rows = []
        for _ in time:
            rows.append([data.qpos[0], data.qvel[0]])
            for _ in range(20):
                data.qfrc_applied[0] = law(data.qpos[0])
                mujoco.mj_step(model, data)
        q, v = (np.array(rows) + np.array([5e-4, 5e-3]) * random.standard_normal((len(time), 2))).T
        out[f"r{k}"] = (time, {"qpos/rail": q, "qvel/rail": v})
    return out


def quiet(*_):
    """Progress that nobody looks at."""


def pool_of(one):
    """All candidates of a round's base."""
    return candidates(one.base.fit.problem, elements_of(one.base.fit))


def as_it_is(_, pair):
    """Both by the same steps."""
    return pair


@pytest.fixture(scope="module", params=[step, spring], ids=["step", "spring"])
def first(request, tmp_path_factory):
    """A round in which the spring is taken, rightly or wrongly."""
    study = make_study(tmp_path_factory.mktemp("rail") / "study", XML, PSI, runs(request.param))
    whole = Followed(make_problem(Simulator(study, num_threads=1)), 6.0)
    fitted, held = whole.on(study.recordings[:4]), whole.on(study.recordings[4:])
    base = paired(fit_followed(fitted), held)
    pool = candidates(base.fit.problem, elements_of(base.fit))
    placed = next(c for c in pool if c.effect.name == "joint_spring")
    more = fitted.with_problem(fitted.problem.with_effects((placed,)))
    taken = paired(fit_followed(more, np.append(base.fit.z, [1.0, 0.0]), like=base.fit), held)
    return request.param, Round(base, (), (taken,), taken)


def test_a_curve_is_taken_where_no_listed_law_has_its_shape(first):
    law, one = first
    (found,) = unlisted.with_curves([one], one.taken, pool_of(one), as_it_is, quiet)
    if law is spring:
        assert found.taken is one.taken
        return
    fit, placed = found.taken.fit, found.taken.placed
    assert placed.effect.name == "unlisted" and placed.effect.variables == ("position",)
    assert classes(found, np.random.default_rng(0))[0].chance > 0.99
    values = fit.problem.effect_values(fit.z[None])[0]
    x = np.linspace(-0.2, 0.2, 21)
    knots = np.linspace(values["least"][0], values["most"][0], values["curve"].shape[1])
    error = np.interp(x, knots, values["curve"][0]) - step(x)
    assert np.sqrt(np.mean(error**2)) < 0.1 * SIZE


def unsure(*_):
    """No addition earns anything."""
    return False


def test_who_is_ahead_but_not_surely_leaves_nothing_on_its_joint_sure(first, monkeypatch):
    law, one = first
    monkeypatch.setattr(unlisted, "earns", unsure)
    elsewhere = replace(one, taken=moved(one.taken, "other"))
    rounds = unlisted.with_curves([one, elsewhere, one], one.taken, pool_of(one), as_it_is, quiet)
    assert [r.taken for r in rounds] == [r.taken for r in (one, elsewhere, one)]
    sure = [classes(r, np.random.default_rng(0))[0].chance > 0.5 for r in (rounds[0], rounds[2])]
    assert sure == [law is spring] * 2 and rounds[1] is elsewhere


def moved(pair, joint):
    """The same hypothesis, its effect on a joint of another name."""
    placed = replace(pair.placed, element=replace(pair.placed.element, name=joint))
    problem = pair.fit.problem.with_effects((placed,))
    return replace(pair, fit=replace(pair.fit, followed=pair.fit.followed.with_problem(problem)))


def test_without_a_law_on_a_joint_nothing_is_simulated(first):
    _, one = first
    pool, counter, stages = pool_of(one), one.base.fit.problem.simulator.counter, []
    begun = counter.simulations
    assert unlisted.curves(one.base, one.base, pool, 0.0, lambda *stage: stages.append(stage)) == []
    assert counter.simulations == begun and not stages


def test_laws_on_one_joint_have_one_place_and_what_they_hold_to_is_none_of_it(first, monkeypatch):
    _, one = first
    spring, asked, screened = one.taken.placed, [], unlisted.screened
    coupled = replace(spring, element=replace(spring.element, source="other", source_dof=1, source_qpos=1))
    both = one.taken.fit.problem.with_effects((coupled, spring))
    after = replace(one.taken, fit=replace(one.taken.fit, followed=one.taken.fit.followed.with_problem(both)))
    monkeypatch.setattr(unlisted, "screened", lambda fit, places: asked.append(places) or [])
    assert unlisted.curves(one.base, after, pool_of(one), 0.0, quiet) == []
    assert asked == [[(spring.element, spring.typical)]]
    assert screened(one.base.fit, asked[0])[0].placed.element == spring.element


def test_a_listed_law_of_two_effects_is_fitted_where_it_predicts_as_a_curve_does(first):
    law, one = first
    pool = pool_of(one)
    damping = next(c for c in pool if c.effect.name == "viscous_damping")
    followed = one.taken.fit.followed
    both = followed.with_problem(followed.problem.with_effects((one.taken.placed, damping)))
    listed = paired(at(both, np.append(one.taken.fit.z, 0.2)), one.taken.held.followed)
    curve = unlisted.curves(one.base, listed, pool, 2.0, quiet)[0]
    there = caught_up(listed, curve)
    start = at(both.remembering(curve.fit.followed.memory), np.append(curve.fit.z[:1], listed.fit.z[1:]))
    assert there.fit.problem.effects == listed.fit.problem.effects and there.fit.loss < start.loss
    assert there.fit.followed.memory == curve.fit.followed.memory
    assert (unlisted.lead(curve, there) > 100) == (law is step)


def test_what_a_curve_leaves_beyond_noise_may_be_memory(first):
    _, one = first
    curve = unlisted.curves(one.base, one.taken, pool_of(one), 2.0, quiet)[0]
    values = curve.fit.problem.effect_values(curve.fit.z[None])[0]
    for inflation, memory in ((1.0, "none"), (4.0, "possible")):
        fit = SimpleNamespace(problem=curve.fit.problem, noise_inflation=inflation)
        assert described(fit, curve.placed, values)["memory"] == memory
