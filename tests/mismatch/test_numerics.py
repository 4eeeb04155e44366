"""A timestep that is too coarse is told from one that is not, and from missing physics."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import PENDULUM, fit, noise_table, place, pose, recordings, run

from det2stoc_bayes.mismatch import diagnose as module
from det2stoc_bayes.mismatch import numerics
from det2stoc_bayes.mismatch.diagnose import diagnose
from det2stoc_bayes.mismatch.evidence import log_evidence
from det2stoc_bayes.mismatch.explain import Explanation
from det2stoc_bayes.mismatch.numerics import (
    Numerics,
    by_steps,
    check_numerics,
    comparable,
    converging,
    corrected,
    held_error,
    simulated,
)
from det2stoc_bayes.mismatch.race import threshold
from det2stoc_bayes.mismatch.statements import finer_step
from det2stoc_bayes.optimize import fit_many

COARSE = '<option timestep="0.02" integrator="Euler" gravity="0 0 -9.81"/>'
FINE = '<option timestep="0.001" integrator="RK4" gravity="0 0 -9.81"/>'
GOOD = '<option timestep="0.005" integrator="RK4" gravity="0 0 -9.81"/>'
STARTS = [([1.5], [0.0]), ([-0.4], [4.0])]
PSI = """
[psi.damping]
target = "joint/pivot/damping"
prior = { Normal = { loc = 0.05, scale = 0.02 } }
"""


def believed(folder, option, noise=(2e-3, 2e-2), reality=FINE, **options):
    """What a fine simulation recorded, believed to come from another."""
    made = recordings(model_xml(PENDULUM, option=reality), STARTS, 20 * np.arange(60), noise, **options)
    return fit(pose(make_study(folder / "study", model_xml(PENDULUM, option=option), PSI + noise_table(*noise), made)))


def test_a_coarse_timestep_is_found(tmp_path):
    base = believed(tmp_path, COARSE)
    found = check_numerics(base, 0.02, 20)
    assert found.integrator == "RK4" and found.timestep in (0.02, 0.01, 0.005)
    # Measured: 28 before, 1.02 after.
    assert base.noise_inflation > 5 and found.fit.noise_inflation == pytest.approx(1.0, abs=0.3)
    assert found.gain > 100  # measured: 389 nats
    problem = found.fit.problem
    assert (problem.timestep, problem.integrator) == (found.timestep, "RK4")


def test_an_error_that_noise_all_but_hides_is_no_finding(tmp_path):
    """It gains what any of twenty candidates may gain by chance."""
    base = believed(tmp_path, COARSE, (5e-2, 5e-1))
    better = fit_many([(replace(base.problem, timestep=0.005, integrator="RK4"), base.point)])[0]
    assert np.log(20) < log_evidence(better) - log_evidence(base) < threshold(20)  # measured: 8.2 of 3.0 to 10.0
    assert check_numerics(base, 0.02, 20) is None


@pytest.mark.parametrize("option", [GOOD, GOOD.replace("RK4", "Euler").replace("0.005", "0.0002")])
def test_a_fine_one_is_not(tmp_path, option):
    base = believed(tmp_path, option)
    assert base.noise_inflation < 1.3
    assert check_numerics(base, float(option.split('"')[1]), 20) is None


@pytest.mark.parametrize(("step", "noise"), [(0.01, (2e-4, 2e-3)), (0.004, (2e-4, 2e-3)), (0.005, (2e-6, 2e-5))])
def test_recordings_of_a_simulation_may_have_an_error_of_their_own(tmp_path, step, noise):
    """Which no converged one has, and at half the step is as far off as the believed one is on the other side."""
    base = believed(tmp_path, COARSE, noise, COARSE.replace("0.02", str(step)))
    converged = by_steps(base, 0.005, "RK4")
    told = simulated(converged, 0.02, 20)
    assert converged.noise_inflation > 10
    assert (told.timestep, told.integrator) == (step, "Euler") and told.gain > threshold(20)
    assert told.fit.noise_inflation == pytest.approx(1.0, abs=0.25)
    assert converging(told.fit, told) == (told.fit, told)  # RK4 tells it worse
    assert simulated(told.fit, 0.02, 20) is None


def test_recordings_simulated_at_half_the_step_are_told_so(tmp_path):
    base = believed(tmp_path, COARSE, (2e-4, 2e-3), COARSE.replace("0.02", "0.01"))
    assert check_numerics(base, 0.02, 20) is None
    told = module._search(base, lambda *_: None)
    assert (told.numerics.timestep, told.numerics.integrator, told.effects) == (0.01, "Euler", ())


def test_the_error_of_simulated_recordings_is_not_looked_for_among_effects(tmp_path):
    def dragged(model, data):
        data.qfrc_applied[0] = -0.1 * data.qvel[0] * abs(data.qvel[0])

    base = believed(tmp_path, COARSE, (1e-3, 1e-2), COARSE.replace("0.02", "0.004"), push=dragged)
    assert simulated(by_steps(base, 0.005, "RK4"), 0.02, 20) is None  # what is missing is no error of steps
    told = module._search(base, lambda *_: None)
    (effect,) = told.effects
    assert effect.effect.name in ("quadratic_damping", "quadratic_drag")  # of a pendulum's rod the same
    assert (told.numerics.timestep, told.numerics.integrator) == (0.004, "Euler")
    assert told.found.after.noise_inflation == pytest.approx(1.0, abs=0.2)


def test_what_looks_like_an_error_of_steps_to_first_order_is_looked_for(tmp_path):
    """A semi-implicit step is late by half of it, as a sensor may be."""
    made = recordings(model_xml(PENDULUM, option=FINE), [*STARTS, ([0.8], [-3.0])], 20 * np.arange(60), (2e-3, 1e-2))
    for time, table in made.values():
        table["qvel/pivot"] = np.interp(time - 0.002, time, table["qvel/pivot"])
    study = make_study(tmp_path / "study", model_xml(PENDULUM, option=COARSE), PSI + noise_table(2e-3, 1e-2), made)
    base = fit(pose(study))
    assert simulated(check_numerics(base, 0.02, 20).fit, 0.02, 20) is not None
    told = module._search(base, lambda *_: None)
    assert [e.label for e in told.effects] == ["sensor_delay on sensor qvel/pivot"]
    assert told.numerics.integrator == "RK4"


def test_missing_physics_is_not_blamed_on_the_timestep(tmp_path):
    def twisted(model, data):
        data.qfrc_applied[0] = 0.3 * np.sin(4 * data.qpos[0])

    base = believed(tmp_path, GOOD, push=twisted)
    assert base.noise_inflation > 3
    assert check_numerics(base, 0.005, 20) is None


def test_an_error_of_integration_that_missing_physics_hides_is_no_effect(tmp_path):
    """A delay of a sensor and less gravity were named for it, beside the ripple that hid it."""

    def twisted(model, data):
        data.qfrc_applied[0] = 0.3 * np.sin(4 * data.qpos[0])

    noise, coarse = (5e-4, 5e-3), COARSE.replace("0.02", "0.01")
    made = recordings(model_xml(PENDULUM, option=FINE), STARTS, 20 * np.arange(60), noise, push=twisted)
    study = make_study(tmp_path / "study", model_xml(PENDULUM, option=coarse), PSI + noise_table(*noise), made)
    assert check_numerics(fit(pose(study)), 0.01, 20) is None
    told = diagnose(study).finding
    assert told.verdict == "mismatch" and [e.name for e in told.effects] == ["cogging_torque"]
    low, high = told.effects[0].parameters["amplitude"].interval
    assert low < 0.3 < high  # measured: 0.30049 +- 0.00032
    assert "integrates by RK4 at 0.01 s" in told.summary


def test_a_change_that_gains_no_evidence_is_not_blamed(tmp_path, monkeypatch):
    base = believed(tmp_path, COARSE)
    monkeypatch.setattr(numerics, "log_evidence", lambda fit, _: 8.0 * (fit is not base))
    assert check_numerics(base, 0.02, 20) is None
    assert check_numerics(base, 0.02, 1) is not None


SLIGHTLY_COARSE = '<option timestep="0.002" integrator="Euler" gravity="0 0 -9.81"/>'


def test_a_slight_error_of_integration_does_not_bias(tmp_path):
    """As a fit at the finer step finds, at the believed step's price; other recordings are simulated finely."""
    base = believed(tmp_path, SLIGHTLY_COARSE)
    better = corrected(base)
    assert better.chi2 < base.chi2 - 10
    fine = fit(replace(base.problem, timestep=better.problem.finer.timestep, integrator="RK4"))
    sd = np.sqrt(fine.covariance[0, 0])
    off = [abs(f.point.z[0] - fine.point.z[0]) / sd for f in (base, better)]
    assert off[1] < 0.05 < 0.5 < off[0]
    other = better.problem.on(better.problem.segments)
    assert (other.integrator, other.finer) == ("RK4", None)
    assert f"by RK4 at {better.problem.finer.timestep:g} s" in finer_step(better.problem)
    assert finer_step(base.problem) == ""


def test_the_error_of_steps_that_a_fit_is_rid_of_is_held_however_large(tmp_path):
    """The believed model's predictions then are those by the finer steps, and so is what is found."""
    base = believed(tmp_path, COARSE)
    found = check_numerics(base, 0.02, 20)
    held = held_error(found.fit)
    assert (held.problem.timestep, held.problem.finer.timestep) == (None, found.timestep)
    assert base.noise_inflation > 5 and held.noise_inflation == pytest.approx(found.fit.noise_inflation, abs=0.01)
    np.testing.assert_allclose(held.point.z, found.fit.point.z, atol=0.01 * np.sqrt(held.covariance[0, 0]))
    assert f"by RK4 at {found.timestep:g} s" in finer_step(held.problem)


@pytest.mark.parametrize("absorbed", [False, True])
def test_a_step_that_does_not_converge_for_what_is_told_is_changed(tmp_path, monkeypatch, absorbed):
    """It may have for the believed model, over shorter stretches; what psi makes up for counts as well."""
    base = believed(tmp_path, COARSE)
    step = {"timestep": 0.005, "integrator": "Euler"}
    short = fit(replace(base.problem, **step))
    if absorbed:
        monkeypatch.setattr(numerics, "_change", lambda *_: 0.0)
    better, told = converging(short, Numerics(*step.values(), 50.0, base))
    assert (better.problem.timestep, better.problem.integrator) == (told.timestep, told.integrator)
    assert told.integrator == "RK4" and told.gain == 50.0
    assert (told.fit.problem.timestep, told.fit.problem.integrator) == (told.timestep, "RK4")
    fine = fit(replace(base.problem, timestep=0.001, integrator="RK4"))
    off = [abs(f.point.z[0] - fine.point.z[0]) / np.sqrt(fine.covariance[0, 0]) for f in (short, better)]
    assert off[1] < 0.1 < 3.0 < off[0]  # measured: 7.8 and 0.02
    assert converging(better, told) == (better, told) and converging(better, None) == (better, None)
    assert converging(base, None) == (base, None)  # the believed steps are asked for elsewhere


def test_a_step_that_recordings_prefer_is_kept(tmp_path):
    """What was recorded of a simulation has its error, which no smaller step has."""
    base = believed(tmp_path, COARSE)
    own = fit(replace(base.problem, timestep=0.01, integrator="Euler"))
    recorded = own.problem.simulator.rollout(own.problem.request(own.point.z[None], own.point.start))
    segments = replace(own.problem.segments, values=recorded.reshape(own.problem.segments.values.shape))
    told = fit(replace(own.problem, segments=segments), own.point.z)
    step = Numerics(0.01, "Euler", 50.0, base)
    assert converging(told, step) == (told, step)
    assert converging(own, step)[0].problem.integrator == "RK4"


def _looked_for(monkeypatch, base, first, better):
    """What is searched of a fit where the first explanation is one fit, and by finer steps another."""
    searched = []

    def explained(before, pool, looks):
        searched.append((before.problem.timestep, looks))
        after = first if before.problem.timestep is None else better
        return Explanation(before, after, (), len(pool), 1.0)

    monkeypatch.setattr(module, "explain_by_all", explained)
    monkeypatch.setattr(module, "check_numerics", lambda f, *_: None if f is base else Numerics(0.005, "RK4", 50.0, f))
    return module._search(base, lambda *_: None), searched


@pytest.mark.parametrize("tells_more", [True, False])
def test_integration_is_asked_for_beside_all_that_was_found(tmp_path, monkeypatch, tells_more):
    base = believed(tmp_path, COARSE, (5e-2, 5e-1))  # nothing is missing that a candidate would explain
    placed = place(base.problem, "quadratic_damping", "pivot")
    first = replace(fit(base.problem.with_effects([placed])), chi2=2.0 * base.linear.degrees_of_freedom)
    better = replace(first, chi2=(1.0 if tells_more else 3.0) * base.linear.degrees_of_freedom)
    found, searched = _looked_for(monkeypatch, base, first, better)
    assert [step for step, _ in searched] == [None, 0.005] and searched[0][1] is not searched[1][1]
    assert found.found.after is (better if tells_more else first)
    assert (found.numerics is not None) is tells_more and found.looks is searched[tells_more][1]
    if tells_more:  # the believed model's own fit, not that with the effect
        assert found.numerics.fit.problem.effects == () and found.numerics.fit.problem.timestep == 0.005


def test_what_a_finer_step_will_gain_is_foretold(tmp_path):
    """To first order, so that rivals which stay far behind are not fitted again."""
    base = believed(tmp_path, SLIGHTLY_COARSE)
    _, _, shift = numerics._converged(base, base.problem.simulator.model.opt.timestep)
    gained = log_evidence(corrected(base)) - log_evidence(base)
    assert gained > 5
    assert numerics._promise(base, shift) == pytest.approx(gained, rel=0.05, abs=0.3)


def test_a_fine_step_or_a_large_misfit_is_not_corrected(tmp_path):
    good, bad = believed(tmp_path / "good", GOOD), believed(tmp_path / "bad", COARSE)
    assert corrected(good) is good and corrected(bad) is bad


def test_a_step_that_diverges_does_not_converge(tmp_path):
    """RK4 at the believed step is unstable on what Euler damps implicitly."""
    body = """<body name="light"><joint name="slide" type="slide" axis="1 0 0" damping="15.5" stiffness="30"/>
      <geom size="0.1" mass="0.01" contype="0" conaffinity="0"/></body>"""
    option = '<option timestep="0.002" integrator="{}" gravity="0 0 0"/>'
    made = recordings(
        model_xml(body, option=option.format("implicit")), [([0.5], [0.0])], 20 * np.arange(40), (1e-6, 1e-5)
    )
    toml = '[psi.stiffness]\ntarget = "joint/slide/stiffness"\nprior = { Normal = { loc = 30, scale = 3 } }\n'
    toml += noise_table(1e-6, 1e-5)
    base = fit(pose(make_study(tmp_path / "study", model_xml(body, option=option.format("Euler")), toml, made)))
    found = numerics._converged(base, 0.002)
    assert found is not None and found[0] < 0.002 and np.isfinite(found[2]).all()
    assert np.isfinite(corrected(base).chi2)


DRIVEN = """
<body name="bob"><joint name="run" type="slide" axis="1 0 0" damping="0.4" stiffness="900"/>
  <geom size="0.1" mass="1.2" contype="0" conaffinity="0"/></body>"""
MOTOR = '<actuator><motor name="push" joint="run"/></actuator>'
DRIVEN_PSI = PSI.replace("pivot", "run").replace("loc = 0.05, scale = 0.02", "loc = 0.4, scale = 0.1")
LAG, EVERY = 2.6e-3, 20  # s; fine steps a sample


def lagged_commands(sent):
    """What passes a first-order filter, as its mean over each fine step."""
    step, level, out = 0.0005, sent[0], []
    for goal in np.repeat(sent, EVERY):
        out.append(goal + (level - goal) * LAG / step * (1 - np.exp(-step / LAG)))
        level = goal + (level - goal) * np.exp(-step / LAG)
    return np.array(out)


def test_an_error_of_integration_does_not_choose_between_rivals(tmp_path):
    """A short lag recorded by fine steps and believed at coarse ones, at which a delay fits better."""
    option = '<option timestep="{}" integrator="RK4" gravity="0 0 0"/>'
    time, sd, made = 0.01 * np.arange(200), (4e-4, 4e-3), {}
    rng = np.random.default_rng(0)
    for n in range(3):
        sent = 20 * np.sign(np.sin(2 * np.pi * (1 + n) * time + n))
        got = lagged_commands(sent)[:, None]
        _, states = run(
            model_xml(DRIVEN, MOTOR, option=option.format(0.0005)), ([0.2], [0.0]), np.arange(len(got)), ctrl=got
        )
        states = states[::EVERY] + sd * rng.standard_normal((len(time), 2))
        made[f"run_{n}"] = (time, {"qpos/run": states[:, 0], "qvel/run": states[:, 1], "ctrl/push": sent})
    xml = model_xml(DRIVEN, MOTOR, option=option.format(0.005))
    problem = pose(make_study(tmp_path / "study", xml, DRIVEN_PSI + noise_table(*sd), made))
    effects = [place(problem, name, "push") for name in ("actuator_delay", "actuator_lag")]
    delay, lag = (fit(problem.with_effects([e]), [0, 0.1], max_iterations=20) for e in effects)
    assert log_evidence(delay) > log_evidence(lag) + 5  # measured: 11.7 nats
    delay, lag = comparable([delay, lag])
    assert log_evidence(lag) > log_evidence(delay) + 20  # measured: 37 nats
    assert lag.problem.effect_values(lag.point.z[None])[0]["time_constant"] == pytest.approx(LAG, rel=0.01)
    assert lag.noise_inflation == pytest.approx(1.0, abs=0.1)
