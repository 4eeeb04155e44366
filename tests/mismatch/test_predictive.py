"""Predictive check, left-out recordings and stacking."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from simulated import fit, spring_problem

from det2stoc_bayes.mismatch.belief import believe
from det2stoc_bayes.mismatch.crossed import refitted_without
from det2stoc_bayes.mismatch.heldout import held_out
from det2stoc_bayes.mismatch.leave_out import checked, k_hats
from det2stoc_bayes.mismatch.predictive import check
from det2stoc_bayes.psis import reliable, smooth, stacking_weights
from det2stoc_bayes.segments import cut


def push(model, data):
    data.qfrc_applied[0] = -1.5 * abs(data.qvel[0]) * data.qvel[0]


def test_p_values_are_uniform_under_the_right_model(tmp_path):
    p = [check(fit(spring_problem(tmp_path / str(s), seed=s), free_scale=False), s).p_values for s in range(40)]
    for channel in np.transpose(p):
        assert stats.kstest(channel, "uniform").pvalue > 0.01


def test_it_fails_where_something_is_left_out(tmp_path):
    found = check(fit(spring_problem(tmp_path, push=push, noise=1e-3)), 0)
    assert found.fails and found.p_value < 1e-6
    assert str(found.worst) in found.text() and "unexplained" in found.text()


def spoilt(problem, samples):
    """The same recordings, some samples of the first one's first column 30 noise sds off."""
    first, *rest = problem.segments.recordings
    values = first.values.copy()
    values[samples, 0] += 30 * problem.simulator.study.noise[first.columns[0]]
    return problem.on(cut((replace(first, values=values), *rest)))


@pytest.mark.parametrize("samples", [[20, 33], [0], [0, 39]])
def test_lone_samples_far_off_are_told_as_glitches(tmp_path, samples):
    found = check(fit(spoilt(spring_problem(tmp_path), samples)), 0)
    assert found.fails and len(found.glitches) == len(samples)
    assert ("2 samples, each alone, are" if len(samples) > 1 else "a lone sample is") in found.text()
    assert 27 < min(found.glitches) <= max(found.glitches) < 33


def test_a_misfit_between_holes_and_one_beside_a_glitch_are_no_glitches(tmp_path):
    wrong = spring_problem(tmp_path / "wrong", push=push, noise=1e-3)
    first, *rest = wrong.segments.recordings
    values = first.values.copy()
    values[1::2] = np.nan
    assert not check(fit(wrong.on(cut((replace(first, values=values), *rest)))), 0).glitches
    found = check(fit(spoilt(wrong, [20])), 0)
    assert found.fails and not found.glitches and "unexplained" in found.text()


def test_what_neighbours_share_is_no_glitch(tmp_path):
    found = check(fit(spoilt(spring_problem(tmp_path), [20, 21, 22])), 0)
    assert found.fails and not found.glitches and "unexplained" in found.text()


@pytest.mark.parametrize("wrong", [False, True])
def test_a_model_without_unknowns(tmp_path, wrong):
    problem = spring_problem(tmp_path, toml="", push=push if wrong else None)
    assert problem.size == 0
    assert check(fit(problem), 0).fails == wrong


def test_a_left_out_recording_is_refitted_exactly(tmp_path):
    problem = spring_problem(tmp_path)
    full = fit(problem, tolerance=1e-5)
    kept = tuple(problem.segments.recordings[1:])
    direct = fit(problem.on(cut(kept)), full.point.z, tolerance=1e-5)
    sd = np.sqrt(np.diag(direct.covariance))
    assert (np.abs(refitted_without(full, {"run_0"}) - direct.point.z) < 0.1 * sd).all()


def test_doubtful_recordings_alone_are_scored_anew(tmp_path):
    full = fit(spring_problem(tmp_path))
    belief, held = believe(full, 1.0, 0), held_out(full)
    told = k_hats(belief)
    again, k, refitted = checked(full, held, belief)
    assert k == told and set(refitted) == {n for n, v in told.items() if v > reliable(len(belief.z))}
    same = [i for i, n in enumerate(held.names) if n not in refitted]
    np.testing.assert_array_equal(again.log_density[same], held.log_density[same])


def test_k_hat_of_known_tails():
    random = np.random.default_rng(0)
    for k in (0.3, 1.0):
        weights = np.log1p(stats.genpareto(k).rvs(4000, random_state=random))
        assert smooth(weights)[1] == pytest.approx(k, abs=0.25)
    assert smooth(np.full(100, -np.inf))[1] == np.inf
    assert smooth(np.zeros(100))[1] < 0


def test_stacking():
    # Each of two models is right about half of the recordings; a third is never right.
    p = np.log([[0.9, 0.1, 0.01], [0.1, 0.9, 0.01]] * 5)
    np.testing.assert_allclose(stacking_weights(p - 9000.0), [0.5, 0.5, 0.0], atol=1e-4)
    assert stacking_weights(np.array([[-10.0, -5000.0]] * 3))[0] == pytest.approx(1.0, abs=1e-6)
