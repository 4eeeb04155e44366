"""Every form of every effect: trials that screening takes, starts for refinement, columns that are right."""

from dataclasses import replace

import numpy as np
import pytest
from catalogue import AIR, FORMS, place_form
from conftest import ARM, MOTORS, make_study, model_xml
from simulated import here, pose, recordings

from det2stoc_bayes.engines.base import EffectRows
from det2stoc_bayes.engines.magnitudes import Magnitudes
from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.changes import changes
from det2stoc_bayes.mismatch.effects import CATALOGUE, Typical
from det2stoc_bayes.segments import cut

STEPS = 5 * np.arange(41)  # 0.4 s


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Two recordings of a driven arm in moving air, linearized where they are."""
    xml = model_xml(ARM, MOTORS, option=AIR.format("Euler"))
    commands = [0.5 + np.sin(np.outer(0.1 * np.arange(len(STEPS)), [9.0, 7.0]) + s) for s in range(2)]
    starts = [([0.4, -0.3], [1.0, -2.0]), ([-0.5, 0.6], [-1.0, 0.5])]
    made = recordings(xml, starts, STEPS, (0.0,), ctrl=commands)
    return here(pose(make_study(tmp_path_factory.mktemp("study") / "arm", xml, '[noise]\n"*" = 1e-4\n', made)))


def simulated(fit, placed, values):
    """Change of all samples by whole simulations, starts held."""
    problem = fit.problem
    request = problem.request(fit.point.z[None], fit.point.start)
    added = EffectRows.alike(placed, problem.segments.count, values)
    moved, plain = (problem.simulator.rollout(r) for r in (replace(request, effects=(added,)), request))
    return (moved - plain).reshape(len(plain), -1)


@pytest.mark.parametrize("form", FORMS)
def test_unknowns_and_values_are_one(form):
    effect, typical = FORMS[form], Typical()
    z = np.random.default_rng(0).standard_normal((5, effect.size))
    values = effect.from_normal(list(z.T), typical)
    for p in effect.parameters:
        assert values[p.name].shape == ((5,) if p.size == 1 else (5, p.size))
    again = [effect.to_normal({n: v[i] for n, v in values.items()}, typical) for i in range(5)]
    sine = "phase" in values  # a negative amplitude is another phase, so that the sign of z is not lost either
    np.testing.assert_allclose(again, z, atol=1e-8 if not sine else 1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_refinement_starts_where_the_trial_points(fitted, form):
    placed = place_form(fitted.problem.simulator.model, form)
    effect, typical = placed.effect, placed.typical
    for trial in effect.trials(typical):
        start = effect.combine(trial, np.full(len(trial.columns), 2.0), typical)
        assert np.isfinite(effect.to_normal(start, typical)).all()
        assert all(np.asarray(start[p.name]) > p.absent for p in effect.parameters if p.positive)


# Largest relative errors where they are not small (measured). Joint forces are means over intervals in which the servo
# settles (0.12, 0.02), ripples (0.05, 0.03, 0.03; a wind 0.03); a payload moves far (0.04); a limit has its full size
# (0.3). Friction's narrow peak is passed within an interval (0.03), torque changes within one (0.01), lift is slight
# (0.05). So are a curve's narrow modes (0.01 to 0.03). A hundredth of a body's weight as drag is no small change
# (0.016).
LOOSE = {
    "QuadraticDamping": 0.2,
    "QuadraticDrag": 0.03,
    "JointSpring": 0.04,
    "CubicStiffness": 0.04,
    "CoggingTorque": 0.1,
    "PeriodicForce": 0.1,
    "BaseVibration": 0.06,
    "PeriodicWind": 0.06,
    "Hysteresis": 0.12,
    "Coupling": 0.1,
    "RotatingFrame": 0.09,
    "Tether": 0.03,
    "Attraction": 0.03,
    "PayloadMass": 0.08,
    "TorqueSpeedLimit": 0.5,
    "StribeckFriction": 0.06,
    "LoadDependentFriction": 0.02,
    "MagnusLift": 0.1,
    "OverPosition": 0.05,
    "OverVelocity": 0.05,
    "OverTime": 0.05,
    "OverPositionAndVelocity": 0.05,
    "OverTimeAndVelocity": 0.05,
    "OverTimeAndPosition": 0.05,
}


def test_slow_motions_are_tried_where_recordings_are_cut(fitted):
    """A sine of time goes on from one stretch to the next: what is slower than one of them is seen all the same."""
    problem = fitted.problem
    cut_up = problem.on(cut(problem.segments.recordings, 10, problem.segments.columns))
    assert cut_up.segments.count == 8
    for placed, same in zip(candidates(problem), candidates(cut_up), strict=True):
        assert same.typical.duration == placed.typical.duration == pytest.approx(0.4)
        if placed.effect.name in ("periodic_force", "base_vibration"):
            slowest = min(t.columns[0]["frequency"] for t in same.effect.trials(same.typical))
            assert slowest < 1.1 / 0.4  # one period in a recording; in a stretch at least four times as much


@pytest.mark.parametrize("duration", [0.4, np.nextafter(0.4, 1), 3.0, 7.0, 10.0, 11.0])
@pytest.mark.parametrize("name", ["periodic_force", "base_vibration"])
def test_what_repeats_is_tried_from_one_period_in_a_recording_on(duration, name):
    typical = Typical(force=1.0, speed=1.0, span=1.0, inertia=1.0, duration=duration, sampling=0.01)
    trials = [t.columns[0]["frequency"] for t in CATALOGUE[name].trials(typical)]
    np.testing.assert_allclose(duration * np.array(trials[:4]), [1.0, 1.5, 2.0, 2.5])
    prior = CATALOGUE[name].priors(typical)["frequency"]
    assert float(prior.from_normal(np.array(-9.0))) == pytest.approx(0.75 / duration)  # half of one is a constant


@pytest.mark.parametrize("form", FORMS)
def test_columns_are_changes_of_whole_simulations(fitted, form):
    """The linear response to small trials, against simulations of them from the same starts."""
    placed = place_form(fitted.problem.simulator.model, form)
    placed = replace(placed, typical=Magnitudes(fitted.problem).of(placed.element))
    listed = list(changes(fitted, [placed], lambda n: None))
    every = [(t, c) for _, t, c in listed]
    small = [(t, c) for t, c in every if t.sd == 100.0] or every  # limits have their full size
    small = small[: max(len(small) // 10, 1)]  # slow ripples: an interval is to them a moment
    worst = 0.0
    for trial, columns in small:
        expected = np.stack([simulated(fitted, placed, values) for values in trial.columns], -1)
        assert np.isfinite(columns).all()
        off = np.linalg.norm(columns - expected, axis=(0, 1))
        sizes = np.linalg.norm(expected, axis=(0, 1))
        seen = sizes > 1e-9
        assert (off[~seen] < 1e-9).all()  # what the arm's plane does not see
        worst = max([worst, *(off[seen] / sizes.max())])
    print(f"{form}: {worst:.1e}")
    assert worst < LOOSE.get(form, 0.01)  # measured: 0 to 0.005


def test_each_effect_is_a_candidate_where_it_can_be(fitted):
    found = {p.effect.name for p in candidates(fitted.problem)}
    assert found == {e.name for e in FORMS.values() if e.listed}
