"""Variational inference against what its guides can and cannot be."""

from dataclasses import replace

import numpy as np
import pytest

from det2stoc_bayes.errors import MethodNotApplicable
from det2stoc_bayes.inference import svi
from det2stoc_bayes.models import linear_gaussian
from det2stoc_bayes.psis import smooth

NAMES = ["gravity_x", "gravity_z"]
NUM = 4000
WITHIN = 4 * np.sqrt(2 / NUM)  # four standard errors of a variance of NUM draws, relative


def draws_of(tree):
    return np.stack([tree.posterior[n].values.ravel() for n in NAMES], -1)


def test_without_correlations_it_is_narrower_by_the_closed_form(gaussian_problem):
    """The best such Gaussian has the posterior's conditional variances (Bishop 2006, eq. 10.12)."""
    tree = svi.fit(gaussian_problem, 1, num_samples=NUM, guide="diagonal")
    mean, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    conditional = 1 / np.diag(np.linalg.inv(covariance))
    draws = draws_of(tree)
    assert (np.abs(draws.mean(0) - mean) < 0.1 * np.sqrt(conditional)).all()
    np.testing.assert_allclose(draws.var(0), conditional, rtol=WITHIN)
    assert (conditional < 0.8 * np.diag(covariance)).all()
    assert abs(np.corrcoef(draws.T)[0, 1]) < 4 / np.sqrt(NUM)


@pytest.mark.parametrize("guide", ["full", "flow"])
def test_weights_tell_that_the_guide_came_close(gaussian_problem, guide):
    tree = svi.fit(gaussian_problem, 1, num_samples=NUM, guide=guide)
    weights, k_hat = smooth(tree.sample_stats.log_weight.values.ravel())
    assert k_hat < 0.7  # measured: 0.17 and 0.57
    mean, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    draws, weights = draws_of(tree), np.exp(weights)
    errors = np.sqrt(np.diag(covariance) * (weights**2).sum())
    assert (np.abs(weights @ draws - mean) < 4 * errors).all()
    assert tree.sample_stats.loss.dims == ("step",) and np.isfinite(tree.sample_stats.loss).all()


@pytest.mark.long
def test_the_loss_bounds_the_evidence(gaussian_problem):
    """ELBO <= log evidence, which weights estimate; equal where the guide is the posterior."""
    full, diagonal = (svi.fit(gaussian_problem, 1, num_samples=NUM, guide=g) for g in ("full", "diagonal"))
    weights = full.sample_stats.log_weight.values.ravel()
    evidence = np.log(np.mean(np.exp(weights - weights.max()))) + weights.max()
    elbo = [-float(t.sample_stats.loss.values[-100:].mean()) for t in (full, diagonal)]
    assert elbo[0] == pytest.approx(evidence, abs=0.05)
    covariance = linear_gaussian.exact_posterior(gaussian_problem)[1]
    lost = -0.5 * np.log1p(-(covariance[0, 1] ** 2) / covariance.diagonal().prod())  # mutual information
    assert elbo[1] == pytest.approx(evidence - lost, abs=0.1)


def test_a_flow_needs_two_unknowns(gaussian_problem):
    simulator = gaussian_problem.simulator
    one = replace(simulator.study, parameters=simulator.parameters[:1])
    problem = replace(gaussian_problem, simulator=type(simulator)(one))
    with pytest.raises(MethodNotApplicable, match="flow.*'full'"):
        svi.fit(problem, 0, num_samples=40, guide="flow")
