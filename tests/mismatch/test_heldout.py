"""Scores of recordings that were not fitted."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import (
    SPRING,
    SPRING_PSI,
    add_holdout,
    dense_evidence,
    fit,
    noise_table,
    place,
    pose,
    recordings,
    spring_problem,
)

from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.heldout import DIVERGED, evaluate, fitted, held_out, horizon_samples, leave_one_out
from det2stoc_bayes.segments import cut
from det2stoc_bayes.study import load_study

NOISE = 0.01


def hardening(model, data):
    data.qfrc_applied[0] = -40 * data.qpos[0] ** 3


def holdout_of(xml=None, seed=9, **options):
    starts = [([0.25], [0.3]), ([-0.1], [-0.8])]
    return recordings(model_xml(SPRING), starts, 10 * np.arange(45), (NOISE, 10 * NOISE), seed=seed, **options)


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """A fit of a study with two held-out recordings."""
    problem = spring_problem(tmp_path_factory.mktemp("held"), noise=NOISE)
    add_holdout(problem.simulator.study, holdout_of())
    return fit(pose(load_study(problem.simulator.study.folder)))


@pytest.mark.parametrize("with_effect", [False, True])
def test_one_step_is_a_refit_without_the_recording(tmp_path, with_effect):
    problem = spring_problem(tmp_path, noise=NOISE, push=hardening if with_effect else None)
    if with_effect:
        problem = problem.with_effects([place(problem, "cubic_stiffness", "slide", Typical(force=3, span=0.3))])
    full = fit(problem, tolerance=1e-5)
    found = leave_one_out(full)
    assert list(found) == ["run_0", "run_1", "run_2"]
    records, moves = problem.segments.recordings, []
    for r, record in enumerate(records):
        kept = tuple(x for k, x in enumerate(records) if k != r)
        refit = fit(problem.on(cut(kept)), full.point.z, tolerance=1e-5)
        sd = np.sqrt(np.diag(refit.covariance))
        moves.append(np.abs(full.point.z - refit.point.z) / sd)
        off = np.abs(found[record.name] - refit.point.z) / sd
        assert (off < 0.1).all()  # measured: 0.03 sds at most
    assert np.max(moves) > 0.5  # leaving one out matters: measured up to 1.07


def test_rollouts_start_from_what_was_recorded_before_them(held):
    study = held.problem.simulator.study
    z = dict.fromkeys((r.name for r in study.holdout), held.point.z)
    plain = evaluate(held, z, study.holdout, None)
    changed = []
    for r in study.holdout:
        values = np.array(r.values)
        values[10:] += 0.05 * np.random.default_rng(0).standard_normal(values[10:].shape) + 0.2
        changed.append(replace(r, values=values))
    other = evaluate(held, z, tuple(changed), None)
    warm = []
    for r in study.holdout:
        values = np.array(r.values)
        values[3] += 10 * held.problem.noise
        warm.append(replace(r, values=values))
    moved = evaluate(held, z, tuple(warm), None)
    for r in study.holdout:
        off = np.abs(other.rollouts[r.name] - plain.rollouts[r.name]) / held.problem.noise
        shift = np.abs(moved.rollouts[r.name] - plain.rollouts[r.name]) / held.problem.noise
        # Measured: 1e-4 noise sds, by way of the scale of finite differences and of the start's wide prior.
        assert off.max() < 1e-3
        assert shift.max() > 0.5  # measured: 1.6; the warm-up has its say
    assert (other.chi2 > 10 * plain.chi2).all() and (other.log_density < plain.log_density).all()


def test_densities_are_those_of_dense_gaussians(held):
    """Psi is fixed, so that only the starts are integrated out: a problem without psi says the same."""
    study = held.problem.simulator.study
    found = held_out(held)
    assert found.names == ("holdout_run_0", "holdout_run_1")
    both = held.problem.on(cut(study.holdout, None, held.problem.segments.columns))
    at, fixed = start_point(both, held.point.z), _FixedPsi(both, held.point.z)
    assert found.log_density.sum() == pytest.approx(dense_evidence(fixed, np.zeros(0), at.start), abs=1e-3)
    assert found.log_density.min() > 0.3 * found.log_density.sum()
    for chi2, count in zip(found.chi2, found.num_values, strict=True):
        assert count == 2 * 45 - 2
        assert chi2 == pytest.approx(count, abs=4 * np.sqrt(2 * count))


class _FixedPsi:
    """A problem whose psi is known."""

    def __init__(self, problem, z):
        self.problem, self.z = problem, z

    def __getattr__(self, name):
        return getattr(self.problem, name)

    def request(self, z, start):
        return self.problem.request(self.z[None], start)


def test_rollout_errors_count_what_comes_after_the_warm_up(held):
    study = held.problem.simulator.study
    found = held_out(held)
    assert (found.num_errors == 45 - 10).all()
    for k, r in enumerate(study.holdout):
        off = r.values[10:] - found.rollouts[r.name][10:]
        np.testing.assert_allclose(found.squared_error[k], (off**2).sum(0), rtol=1e-9)
    np.testing.assert_allclose(found.rmse, np.sqrt(found.squared_error.sum(0) / 70))
    # Measured: 1.34 and 1.21 noise sds: the right model, from starts that ten samples tell.
    assert ((found.rmse > 0.9 * held.problem.noise) & (found.rmse < 1.6 * held.problem.noise)).all()


def test_dropped_samples_leave_rollouts_in_step(held):
    """A row without any value is a sample all the same: what follows must not move up."""
    study = held.problem.simulator.study
    r = study.holdout[0]
    values = np.array(r.values)
    values[15], values[20, 0] = np.nan, np.nan
    z = {r.name: held.point.z}
    holed, plain = (evaluate(held, z, (one,), None) for one in (replace(r, values=values), r))
    assert holed.rollouts[r.name].shape == plain.rollouts[r.name].shape
    np.testing.assert_allclose(holed.rollouts[r.name], plain.rollouts[r.name], atol=1e-5)
    assert holed.num_errors.tolist() == [[33.0, 34.0]]


def test_a_rollout_that_diverges_scores_nothing(held):
    study = held.problem.simulator.study
    z = dict.fromkeys((r.name for r in study.holdout), np.array([-1e10, 0.0]))  # a damping that drives
    found = evaluate(held, z, study.holdout, None)
    assert (found.chi2 == DIVERGED * found.num_values).all()  # finite, so that shares of it stay numbers
    assert (found.log_density == -0.5 * found.chi2).all()
    assert np.isnan(found.rollouts["holdout_run_0"]).all()


def test_without_holdout_each_recording_is_left_out_in_turn(tmp_path):
    at = fit(spring_problem(tmp_path, noise=NOISE))
    found, same = held_out(at), fitted(at)
    assert found.names == ("run_0", "run_1", "run_2") == same.names
    # Predicting what was not fitted is never easier, all together.
    assert found.log_density.sum() < same.log_density.sum()
    assert found.log_density.sum() > same.log_density.sum() - 10


def test_stretches_are_as_long_as_those_of_the_fit(tmp_path):
    problem = spring_problem(tmp_path, noise=NOISE)
    whole = fit(problem)
    assert horizon_samples(whole) is None
    short = fit(problem.on(cut(problem.segments.recordings, 20)))
    assert horizon_samples(short) == 20
    found = fitted(short)
    assert found.rollouts["run_0"].shape == (40, 2)
    assert (found.num_errors == 2 * 10).all()


def test_what_is_compared_is_asked_for_the_same_stretches(tmp_path):
    """A hypothesis that follows whole recordings is held against one that does not over those that both follow."""
    problem = spring_problem(tmp_path, noise=NOISE, push=hardening)
    with_effect = problem.with_effects([place(problem, "cubic_stiffness", "slide", Typical(force=3, span=0.3))])
    before, after = fit(problem.on(cut(problem.segments.recordings, 20))), fit(with_effect)
    assert horizon_samples(before, after) == horizon_samples(after, before) == 20
    first, second = held_out(before, after), held_out(after, before)
    assert first.samples == second.samples == 20 and held_out(after).samples is None
    assert (first.num_values == second.num_values).all() and (first.num_errors == second.num_errors).all()
    assert second.chi2.sum() < first.chi2.sum()


def test_a_single_recording_leaves_the_prior(tmp_path):
    xml = model_xml(SPRING)
    made = recordings(xml, [([0.3], [0.0])], 10 * np.arange(40), (NOISE, 10 * NOISE))
    at = fit(pose(make_study(tmp_path / "one", xml, SPRING_PSI + noise_table(NOISE, 10 * NOISE), made)))
    np.testing.assert_allclose(leave_one_out(at)["run_0"], 0.0, atol=1e-6)  # nothing is left but the prior
