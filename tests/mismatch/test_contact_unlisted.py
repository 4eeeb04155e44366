"""Curves in the place of listed laws where bodies touch: taken where no listed law has the shape, and nowhere else."""

import mujoco
import numpy as np
import pytest
from conftest import make_study

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact import unlisted
from det2stoc_bayes.mismatch.contact.fit import fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.judge import classes
from det2stoc_bayes.mismatch.contact.pair import paired
from det2stoc_bayes.mismatch.contact.places import elements_of
from det2stoc_bayes.mismatch.contact.search import Round
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
    (found,) = unlisted.with_curves([one], one.taken, as_it_is, quiet)
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


def test_who_is_ahead_but_not_surely_lessens_the_chance_of_what_was_taken(first, monkeypatch):
    law, one = first
    monkeypatch.setattr(unlisted, "surely", lambda *_: False)
    (found,) = unlisted.with_curves([one], one.taken, as_it_is, quiet)
    assert found.taken is one.taken
    assert (classes(found, np.random.default_rng(0))[0].chance < 0.5) == (law is step)


def test_without_a_law_on_a_joint_there_is_no_curve(first):
    _, one = first
    assert unlisted.curves(one, one.base, 0.0, quiet) == []
