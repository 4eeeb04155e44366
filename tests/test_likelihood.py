"""The projection algebra against dense Gaussians."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from det2stoc_bayes.likelihood import align_quaternions, factorize, residuals


def case(segments=3, values=12, states=4, missing=0.25, seed=0):
    rng = np.random.default_rng(seed)
    sensitivity = rng.standard_normal((segments, values, states))
    recorded = rng.random((segments, values)) > missing
    weight = np.where(recorded, 1 / rng.uniform(0.05, 2, (segments, values)), 0.0)
    prior_sd = rng.uniform(0.1, 10, (segments, states))
    residual = np.where(recorded, rng.standard_normal((segments, values)), 0.0)
    return sensitivity, weight, prior_sd, residual


def dense(sensitivity, weight, prior_sd, residual):
    """Sum over segments of log N(r; 0, R + A P A') of the recorded values."""
    total = 0.0
    for a, w, p, r in zip(sensitivity, weight, prior_sd, residual, strict=True):
        seen = w > 0
        covariance = np.diag(w[seen] ** -2) + a[seen] @ np.diag(p**2) @ a[seen].T
        total += multivariate_normal(np.zeros(seen.sum()), covariance).logpdf(r[seen])
    return total


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("values", [12, 3])  # more and fewer values than states
def test_log_density_is_that_of_a_dense_gaussian(missing, values):
    sensitivity, weight, prior_sd, residual = case(values=values, missing=missing)
    latent = factorize(sensitivity, weight, prior_sd)
    projected = latent.project(latent.stack(residual[..., None]))
    log_density = latent.log_normalizer - 0.5 * float((projected**2).sum())
    assert log_density == pytest.approx(dense(sensitivity, weight, prior_sd, residual), rel=1e-10)
    assert latent.num_observed == int((weight > 0).sum())


def test_values_that_were_not_recorded_do_not_matter():
    sensitivity, weight, prior_sd, residual = case()
    latent = factorize(sensitivity, weight, prior_sd)
    other = factorize(np.where(weight[..., None] > 0, sensitivity, 7.0), weight, prior_sd)
    rubbish = np.where(weight > 0, residual, 1e3)
    np.testing.assert_allclose(
        latent.project(latent.stack(residual[..., None])),
        other.project(other.stack(rubbish[..., None])),
        atol=1e-10,
    )
    assert latent.log_normalizer == pytest.approx(other.log_normalizer)


def test_inner_products_of_columns_are_those_of_the_dense_precision():
    sensitivity, weight, prior_sd, _ = case(missing=0.0)
    columns = np.random.default_rng(1).standard_normal((*weight.shape, 3))
    latent = factorize(sensitivity, weight, prior_sd)
    projected = latent.project(latent.stack(columns))
    for s in range(len(weight)):
        covariance = np.diag(weight[s] ** -2) + sensitivity[s] @ np.diag(prior_sd[s] ** 2) @ sensitivity[s].T
        np.testing.assert_allclose(
            projected[s].T @ projected[s], columns[s].T @ np.linalg.solve(covariance, columns[s]), rtol=1e-9
        )


def test_the_best_start_is_the_posterior_mean():
    sensitivity, weight, prior_sd, residual = case()
    latent = factorize(sensitivity, weight, prior_sd)
    best = latent.best_start(latent.stack(residual[..., None]))
    for s in range(len(weight)):
        a = sensitivity[s] * weight[s][:, None]
        precision = a.T @ a + np.diag(prior_sd[s] ** -2)
        np.testing.assert_allclose(best[s], np.linalg.solve(precision, a.T @ (residual[s] * weight[s])), rtol=1e-9)


def test_a_start_off_its_prior_mean_costs_what_the_prior_says():
    # Linearized about x1 instead of x0: residual r - A d, d = x1 - x0; the density must not change.
    sensitivity, weight, prior_sd, residual = case()
    latent = factorize(sensitivity, weight, prior_sd)
    d = np.random.default_rng(2).standard_normal(prior_sd.shape)
    there = residual - np.where(weight > 0, np.einsum("svk,sk->sv", sensitivity, d), 0.0)
    moved = latent.project(latent.stack(there[..., None], -d[..., None]))
    here = latent.project(latent.stack(residual[..., None]))
    np.testing.assert_allclose((moved**2).sum(), (here**2).sum(), rtol=1e-9)


def test_both_array_libraries_agree():
    sensitivity, weight, prior_sd, residual = case()
    latent = factorize(sensitivity, weight, prior_sd)
    plain = latent.project(latent.stack(residual[..., None]))
    traced = latent.project(latent.stack(jnp.asarray(residual[..., None]), xp=jnp), jnp)
    np.testing.assert_allclose(plain, traced, atol=1e-5 * np.abs(plain).max())


@pytest.mark.parametrize("xp", [np, jnp])
def test_quaternions_are_compared_up_to_their_sign(xp):
    rng = np.random.default_rng(3)
    observed = rng.standard_normal((2, 5, 6))
    observed[..., 1:5] /= np.linalg.norm(observed[..., 1:5], axis=-1, keepdims=True)
    flipped = observed.copy()
    flipped[0, ::2, 1:5] *= -1
    predicted = align_quaternions(xp.asarray(flipped), xp.asarray(observed), [[1, 2, 3, 4]], xp)
    np.testing.assert_allclose(predicted, observed, rtol=1e-6)
    assert flipped[0, 0, 1] == -observed[0, 0, 1]  # the input is untouched
    np.testing.assert_allclose(residuals(xp.asarray(flipped), xp.asarray(observed), [[1, 2, 3, 4]], xp), 0, atol=1e-6)


@pytest.mark.parametrize("xp", [np, jnp])
def test_missing_values_have_no_residual(xp):
    observed = np.array([[[1.0, np.nan], [np.nan, 4.0]]])
    out = residuals(xp.full((1, 2, 2), 0.5), xp.asarray(observed), [], xp)
    np.testing.assert_allclose(out, [[0.5, 0.0, 0.0, 3.5]])
    # A quaternion with a dropped sample stays as it is there.
    observed = np.full((1, 2, 4), np.nan)
    observed[0, 1] = [1, 0, 0, 0]
    predicted = xp.asarray(np.array([[[-1.0, 0, 0, 0], [-1.0, 0, 0, 0]]]))
    np.testing.assert_allclose(align_quaternions(predicted, xp.asarray(observed), [[0, 1, 2, 3]], xp)[0, :, 0], [-1, 1])
