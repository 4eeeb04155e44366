"""The density: one function for every method, whatever computes it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.infer.util import log_density as numpyro_log_density

from det2stoc_bayes.density import Density, scale_of
from det2stoc_bayes.errors import MethodNotApplicable
from det2stoc_bayes.map import expand, find_map, find_mode
from det2stoc_bayes.models import linear_gaussian
from det2stoc_bayes.problem import make_problem


@pytest.fixture(scope="module")
def density(gaussian_problem):
    return Density.at(find_map(gaussian_problem))


@pytest.fixture(scope="module")
def density_mjx(gaussian_problem_mjx):
    return Density.at(find_map(gaussian_problem_mjx))


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).standard_normal((5, 2))


def test_log_likelihood_at_the_map_is_the_fit_s(gaussian_problem):
    fit = find_map(gaussian_problem)
    assert Density.at(fit).log_likelihood(fit.point.z[None])[0] == pytest.approx(fit.log_likelihood, rel=1e-9)


def test_normalizer_by_segment_sums_to_the_whole(density):
    assert density.normalizer.sum() == pytest.approx(density.latent.log_normalizer, rel=1e-12)


def test_density_is_the_exact_gaussian(density, gaussian_problem, points):
    """log density - log exact posterior is the same everywhere (the evidence)."""
    mean, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    psi = gaussian_problem.psi(points) - mean
    exact = -0.5 * np.einsum("ni,ij,nj->n", psi, np.linalg.inv(covariance), psi)
    assert np.ptp(density.log_density(points) - exact) < 1e-6


def test_density_in_chunks_and_by_recording(density, points, monkeypatch):
    whole = density.log_likelihood_by_recording(points)
    monkeypatch.setattr("det2stoc_bayes.density.MAX_VALUES", 400)
    np.testing.assert_allclose(density.log_likelihood_by_recording(points), whole, rtol=1e-12)
    np.testing.assert_allclose(density.log_likelihood(points), whole.sum(1), rtol=1e-12)


def numeric_gradient(function, z, step=1e-3):
    moved = np.concatenate([z + step * np.eye(len(z)), z - step * np.eye(len(z))])
    values = np.array(function(moved))
    return (values[: len(z)] - values[len(z) :]) / (2 * step)


def test_gradients(density, points):
    value, gradient = density.value_and_grad(points)
    np.testing.assert_allclose(value, density.log_density(points), rtol=1e-12)
    for z, g in zip(points, gradient, strict=True):
        np.testing.assert_allclose(g, numeric_gradient(density.log_density, z), rtol=1e-6, atol=1e-6)


def test_expansion_gradient_is_exact_for_a_linear_model(density, points):
    terms, gradient = find_mode(density).terms_and_grad(points)
    expected = density.terms_and_grad(points)
    np.testing.assert_allclose(terms, expected[0], rtol=1e-12)
    np.testing.assert_allclose(gradient, expected[1], rtol=1e-6, atol=1e-6)


def test_gradients_with_mjx(density_mjx, points):
    value, gradient = density_mjx.value_and_grad(points)
    np.testing.assert_allclose(value, density_mjx.log_density(points), rtol=1e-9)
    np.testing.assert_allclose(gradient[0], numeric_gradient(density_mjx.log_density, points[0]), rtol=1e-6, atol=1e-6)


def test_engines_agree(density, density_mjx, points):
    np.testing.assert_allclose(density_mjx.log_density(points), density.log_density(points), atol=1e-5)


@pytest.mark.parametrize("engine", ["c", "mjx"])
def test_jax_function(engine, density, density_mjx, points):
    chosen = {"c": density, "mjx": density_mjx}[engine]
    function = chosen.jax_log_density()
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(function)))(jnp.asarray(points))
    expected = chosen.value_and_grad(points)
    np.testing.assert_allclose(values, expected[0], rtol=1e-12)
    np.testing.assert_allclose(gradients, expected[1], rtol=1e-9)


def test_chains_are_one_batch_and_are_counted(density, points):
    function, counter = density.jax_log_density(), density.problem.simulator.counter
    before = counter.simulations, counter.gradients
    jax.block_until_ready(jax.vmap(jax.grad(function))(jnp.asarray(points)))
    recordings, variants = 2, 1 + 2 * 2
    assert counter.simulations - before[0] == len(points) * recordings * variants
    assert counter.gradients - before[1] == len(points)


def test_numpyro_joint_is_the_plain_density(density, points):
    model = density.numpyro_model()
    for z in points:
        joint, trace = numpyro_log_density(model, (), {}, {"z": jnp.asarray(z)})
        assert float(joint) == pytest.approx(density.log_density(z[None])[0], abs=1e-9)
    for name, value in density.problem.constrained(points[-1]).items():
        assert float(trace[name]["value"]) == pytest.approx(float(value), rel=1e-9)


def test_divergence_has_no_density_and_no_force(density, points, monkeypatch):
    problem = density.problem

    def diverging(request):
        return np.full((len(request.which), *problem.segments.values.shape[1:]), np.nan)

    monkeypatch.setattr(problem.simulator, "rollout", diverging)
    value, gradient = density.value_and_grad(points)
    assert (value == -np.inf).all()
    np.testing.assert_allclose(gradient, -points)


def test_mode_is_the_closed_form(density, gaussian_problem):
    mode = find_mode(density)
    mean, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    np.testing.assert_allclose(gaussian_problem.psi(mode.center), mean, atol=1e-8)
    scale = np.diag(linear_gaussian.Setting().prior_sd) @ mode.scale
    np.testing.assert_allclose(scale @ scale.T, covariance, rtol=1e-6)
    np.testing.assert_allclose(mode.precision, np.eye(2), atol=1e-6)


def test_expansion_knows_the_bend(density):
    """Second derivatives of a function that has some: squares of what the model predicts."""
    bent = replace(density)
    object.__setattr__(bent, "projected", lambda z: np.stack([z[:, 0] ** 2, z[:, 0] * z[:, 1], z[:, 1]])[None])
    mode = expand(bent, np.array([1.0, 2.0]), np.eye(2))
    np.testing.assert_allclose(mode.slope, [[2, 0], [2, 1], [0, 1]], atol=1e-9)
    np.testing.assert_allclose(mode.curvature, [[2, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]], atol=1e-9)


def test_scale_of_badly_scaled_precision():
    precision = np.array([[1e12, 3e5], [3e5, 1.0]])
    scale = scale_of(precision)
    np.testing.assert_allclose(scale @ scale.T @ precision, np.eye(2), atol=1e-6)
    assert scale[0, 1] == 0


def test_without_unknowns(gaussian_problem):
    study = replace(gaussian_problem.simulator.study, parameters=())
    simulator = type(gaussian_problem.simulator)(study)
    with pytest.raises(MethodNotApplicable, match="declares no psi"):
        find_map(make_problem(simulator))
