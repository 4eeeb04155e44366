"""How far a fit climbs."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import PENDULUM, fit, noise_table, place, pose, recordings

from det2stoc_bayes.mismatch import horizon
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR
from det2stoc_bayes.mismatch.horizon import LARGEST_ERROR, climb, extend, ladder, relative_error
from det2stoc_bayes.segments import cut

STARTS = [([1.2], [0.0]), ([-0.4], [3.0])]
PSI = """
[psi.damping]
target = "joint/pivot/damping"
prior = { Normal = { loc = 0.05, scale = 0.02 } }
"""


def twisted(model, data):
    data.qfrc_applied[0] = 1.5 * np.sin(4 * data.qpos[0] + 1)


def pendulum(folder, length=100, **options):
    xml = model_xml(PENDULUM)
    made = recordings(xml, STARTS, 10 * np.arange(length), (2e-3, 2e-2), **options)
    return pose(make_study(folder / "study", xml, PSI + noise_table(2e-3, 2e-2), made))


@pytest.mark.parametrize(
    ("length", "rungs"),
    [(39, [None]), (40, [20, None]), (159, [20, None]), (160, [20, 80, None]), (1280, [20, 80, 320, None])],
)
def test_rungs(tmp_path, length, rungs):
    problem, time = pendulum(tmp_path, 3), 0.02 * np.arange(length)
    record = replace(
        problem.segments.recordings[0], time=time, values=np.zeros((length, 2)), ctrl=np.zeros((length, 0))
    )
    assert list(ladder(problem.on(cut((record,))))) == rungs


def test_the_right_model_reaches_whole_recordings(tmp_path):
    found = climb(pendulum(tmp_path))
    assert found.problem.segments.count == 2
    assert relative_error(found) < 0.005  # measured: 0.001; the noise does not count
    assert found.noise_inflation == pytest.approx(1.0, abs=0.25)


def test_a_wrong_model_stays_at_what_it_can_predict_until_it_is_mended(tmp_path):
    problem = pendulum(tmp_path, push=twisted)
    stuck = climb(problem)
    whole = fit(problem)
    # Measured: 0.36 and 0.58; short stretches are the least that is asked.
    assert stuck.problem.segments.count == 8 and relative_error(whole) > LARGEST_ERROR
    assert extend(stuck).problem.segments.count == 8  # it is still wrong
    ripple = place(problem, "cogging_torque", "pivot", Typical(force=1.5, span=1.0))
    values = {"amplitude": 1.4, "cycles": 4.05, "phase": 0.95}
    z = np.concatenate([stuck.point.z, ripple.effect.to_normal(values, ripple.typical)])
    mended = extend(fit(stuck.problem.with_effects([ripple]), z))
    assert mended.problem.segments.count == 2 and mended.noise_inflation < 1.3  # measured: 0.99
    assert extend(mended) is mended


def test_what_is_far_from_the_recordings_is_not_asked_to_predict_more(tmp_path, monkeypatch):
    problem = pendulum(tmp_path, push=lambda model, data: np.copyto(data.qfrc_applied, -0.05 * data.qvel**3))
    short = fit(problem.on(cut(problem.segments.recordings, 25)))
    monkeypatch.setattr(horizon, "LARGEST_ERROR", np.inf)
    assert short.noise_inflation > horizon.FAR  # measured: 419
    assert extend(short) is short
    monkeypatch.setattr(horizon, "FAR", np.inf)
    assert extend(short).problem.segments.whole


def test_of_many_short_segments_the_worst_told_and_some_others_are_fitted_while_a_misfit_stays(tmp_path, monkeypatch):
    problem = pendulum(tmp_path, push=twisted)
    every = climb(problem)
    monkeypatch.setattr(horizon, "AMPLE", 100)
    stuck = climb(problem)
    segments = stuck.problem.segments
    assert every.problem.segments.count == 8 and segments.count == 4 and stuck.noise_inflation >= MODEL_ERROR
    assert set(segments.recording) == {0, 1}
    left, place = (
        every.linear.gram()[2],
        list(zip(every.problem.segments.recording, every.problem.segments.first, strict=True)),
    )
    chosen = [place.index(at) for at in zip(segments.recording, segments.first, strict=True)]
    assert left.argmax() in chosen and left[chosen].sum() > 0.6 * left.sum()  # half of them
    assert extend(stuck) is stuck


def test_all_short_segments_are_fitted_where_they_leave_no_misfit(tmp_path, monkeypatch):
    monkeypatch.setattr(horizon, "AMPLE", 100)
    monkeypatch.setattr(horizon, "LARGEST_ERROR", -1.0)  # nothing longer is ever good enough
    assert climb(pendulum(tmp_path)).problem.segments.count == 8


def test_a_model_that_explodes_has_no_horizon(tmp_path):
    problem = pendulum(tmp_path, 40)
    assert climb(problem, np.array([-1e10])) is None


def test_columns_that_hardly_move_have_no_say(tmp_path):
    problem = pendulum(tmp_path, 40)
    found = fit(replace(problem, noise=problem.noise / 3))
    assert relative_error(found) > 0
    still = found.problem.segments.values.copy()
    still[:] = still.mean((0, 1)) + problem.noise * np.random.default_rng(0).standard_normal(still.shape)
    rest = fit(problem.on(replace(problem.segments, values=still)), max_iterations=1)
    assert relative_error(rest) == 0.0


def test_error_beyond_the_noise_is_beside_the_spread(tmp_path):
    problem = pendulum(tmp_path, 40)
    found = fit(replace(problem.on(cut(problem.segments.recordings)), noise=problem.noise / 3))
    r = problem.segments.values - problem.simulator.rollout(problem.request(found.point.z[None], found.point.start))
    beyond = np.sqrt((r**2).mean((0, 1)) - (problem.noise / 3) ** 2)
    expected = (beyond / problem.segments.values.std((0, 1))).max()
    assert relative_error(found) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(("name", "climbs"), [("hysteresis", True), ("cubic_stiffness", False)])
def test_what_remembers_goes_on_where_longer_stretches_are_told_better(tmp_path, monkeypatch, name, climbs):
    """Its memory starts anew at every cut: a rod's hysteresis left 37 times the noise by parts, and 3.4 as a whole."""
    typical = Typical(force=1.5, speed=2.0, span=1.0, inertia=0.1)
    problem = pendulum(tmp_path, push=twisted)
    problem = problem.with_effects([place(problem, name, "pivot", typical)])
    monkeypatch.setattr(horizon, "relative_error", lambda fit: 1000 * LARGEST_ERROR / fit.problem.segments.extent[0])
    assert climb(problem).problem.segments.whole is climbs
