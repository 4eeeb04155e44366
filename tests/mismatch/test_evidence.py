"""Evidence against dense Gaussians, the count of independent samples, and probabilities."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import SPRING, dense_evidence, fit, noise_table, place, pose, spring_problem

from det2stoc_bayes.likelihood import LatentStarts
from det2stoc_bayes.linearization import Linearization, start_point
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import (
    PRIOR_OF_NONE,
    effective_share,
    log_evidence,
    probabilities,
    whitened,
    widened,
)
from det2stoc_bayes.optimize import Fit

SMALL = Typical(force=0.2, speed=1.0, span=0.3, inertia=1.2)


@pytest.mark.parametrize("force", [0.0, 0.5])
def test_differences_of_evidence_are_those_of_dense_gaussians(tmp_path, force):
    """Hypotheses that are linear in their unknowns: none, a force, an offset, both."""
    problem = spring_problem(tmp_path, toml="", push=lambda model, data: data.qfrc_applied.__setitem__(0, force))
    problem = replace(problem, noise=1.4 * problem.noise)  # told a little large, so that no misfit widens it
    push, offset = place(problem, "constant_force", "slide", SMALL), place(problem, "sensor_bias", "qpos/slide", SMALL)
    found, dense = [], []
    for effects in ((), (push,), (offset,), (push, offset)):
        one = problem.with_effects(effects)
        at = fit(one, tolerance=1e-4)
        assert at.noise_scale == 1.0
        found.append(log_evidence(at))
        dense.append(dense_evidence(one, at.point.z, at.point.start))
    # Measured: 2e-6 nats; the constant that is left out is the same for all, whatever the point of linearization.
    np.testing.assert_allclose(np.subtract(found[1:], found[0]), np.subtract(dense[1:], dense[0]), atol=1e-3)
    assert np.ptp(dense) > (10 if force else 0.5)


def test_a_share_of_the_samples_counts_as_that_many_less(tmp_path):
    problem = spring_problem(tmp_path)
    at = fit(problem, tolerance=1e-4)
    precision = np.linalg.inv(at.covariance) - np.eye(2)
    np.testing.assert_allclose(widened(at, 1.0), at.covariance, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(widened(at, 0.25)), 0.25 * precision + np.eye(2), rtol=1e-9)
    np.testing.assert_allclose(widened(at, 0.0), np.eye(2), atol=1e-12)
    z, s2, n = at.point.z, at.noise_scale, at.linear.degrees_of_freedom
    likelihood = -0.5 * n * np.log(s2) - 0.5 * at.chi2 / s2
    difference = log_evidence(at, 1.0) - log_evidence(at, 0.25)
    occam = 0.5 * np.log(np.linalg.det(at.covariance) / np.linalg.det(widened(at, 0.25)))
    assert difference == pytest.approx(0.75 * likelihood + occam)
    assert log_evidence(at, 0.0) == pytest.approx(-0.5 * z @ z)


def residual_fit(folder, residual, inflation=10.0):
    """A fit whose whitened residuals are given (segments, samples, columns)."""
    count, length, _ = residual.shape
    time = 0.01 * np.arange(length)
    made = {f"r{s}": (time, {"qpos/slide": residual[s, :, 0], "qvel/slide": residual[s, :, 1]}) for s in range(count)}
    problem = pose(make_study(folder / "s", model_xml(SPRING), noise_table(1.0, 1.0), made))
    flat = residual.reshape(count, -1, 1)
    none = np.zeros((count, flat.shape[1] + 2, 2))
    latent = LatentStarts(problem.weight, none, np.tile(np.eye(2), (count, 1, 1)), problem.guess.prior_sd)
    empty = np.zeros((count, flat.shape[1] + 2, 0))
    lin = Linearization(problem, start_point(problem), latent, latent.stack(flat), empty)
    chi2 = inflation * lin.degrees_of_freedom
    return Fit(lin, np.zeros((0, 0)), inflation, chi2, 0.0, "converged")


def autoregressive(rho, shape, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(shape)
    for k in range(1, shape[1]):
        x[:, k] = rho * x[:, k - 1] + np.sqrt(1 - rho**2) * x[:, k]
    return x


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9, 0.97])
def test_correlated_residuals_count_less(tmp_path, rho):
    residual = 3 * autoregressive(rho, (4, 2500, 2))
    expected = (1 - rho) / (1 + rho)
    found = effective_share(residual_fit(tmp_path, residual))
    # Measured ratios: 0.84, 0.84, 1.00, 1.00 (the sum of autocorrelations stops late rather than early).
    assert found == pytest.approx(expected, rel=0.25)
    assert effective_share(residual_fit(tmp_path / "within", residual, 1.4)) == 1.0


def test_the_column_with_the_misfit_decides(tmp_path):
    residual = autoregressive(0.0, (4, 1000, 2))
    residual[..., 0] = 50 * autoregressive(0.9, (4, 1000, 1), 1)[..., 0]
    found = effective_share(residual_fit(tmp_path, residual))
    assert found == pytest.approx(0.1 / 1.9, rel=0.3)  # measured ratio: 0.78


def test_whitened_residuals_are_what_no_start_explains(tmp_path):
    problem = spring_problem(tmp_path)
    at = fit(problem, tolerance=1e-4)
    r = whitened(at)
    assert r.shape == problem.segments.values.shape
    plain = problem.segments.values - problem.simulator.rollout(problem.request(at.point.z[None], at.point.start))
    # Measured: 2e-5; at the fitted starts little is left to explain.
    np.testing.assert_allclose(r, plain / problem.noise, atol=1e-2)
    assert np.isfinite(r).all()
    values = problem.segments.values.copy()
    values[0, 5, 1] = np.nan
    holed = whitened(fit(problem.on(replace(problem.segments, values=values))))
    assert np.argwhere(np.isnan(holed)).tolist() == [[0, 5, 1]]


def test_probabilities():
    alone = probabilities([np.log(10)], 10)
    assert alone[0] == pytest.approx(0.5)  # ten candidates share what one gains
    many = probabilities([3.0, 1.0, -50.0, 900.0], 4)
    assert np.all(many >= 0) and many.sum() <= 1 and many[3] == pytest.approx(1.0)
    gains = np.array([2.0, 0.0, 5.0])
    weights = (1 - PRIOR_OF_NONE) / 7 * np.exp(gains)
    np.testing.assert_allclose(probabilities(gains.tolist(), 7), weights / (weights.sum() + PRIOR_OF_NONE))
    assert probabilities([], 0).shape == (0,)
