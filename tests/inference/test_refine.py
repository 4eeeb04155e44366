"""Importance resampling of draws that are not the posterior's."""

from dataclasses import replace

import numpy as np
import pytest

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.doubts import unreliable
from det2stoc_bayes.errors import MethodNotApplicable, SimulationDiverged
from det2stoc_bayes.inference import laplace, svi
from det2stoc_bayes.inference._refine import Weighed, matched
from det2stoc_bayes.inference._sampling import density_of
from det2stoc_bayes.models import linear_gaussian
from det2stoc_bayes.report.summary import summarize
from det2stoc_bayes.study import load_study
from det2stoc_bayes.verbs import fit

NAMES = ["gravity_x", "gravity_z"]
NUM = 2000


def draws_of(tree):
    return np.stack([tree.posterior[n].values.ravel() for n in NAMES], -1)


def approximation(density, shift, stretch):
    """A Gaussian whose mean is off by `shift` posterior sds, its sds by a factor."""
    u = np.random.default_rng(3).standard_normal((NUM, density.size))
    root = stretch * density.scale
    z = density.center + shift * np.sqrt((density.scale**2).sum(1)) + u @ root.T
    return Weighed.of(density, z, log_prior(u) - np.linalg.slogdet(root)[1])


@pytest.fixture(scope="module")
def density(gaussian_problem):
    return density_of(gaussian_problem)


@pytest.mark.parametrize(("shift", "stretch"), [(0.0, 1.0), (4.0, 0.5), (3.0, 3.0)])
def test_it_finds_the_closed_form(density, gaussian_problem, shift, stretch):
    mean, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    drawn = approximation(density, shift, stretch)
    close, moves = matched(density, drawn)
    weights, effective = close.weights, close.effective
    assert (moves == 0) == (shift == 0)
    assert close.k_hat < 0.7 and effective > NUM / 4
    z = np.stack([gaussian_problem.constrained(close.z)[n] for n in NAMES], -1)
    sd = np.sqrt(np.diag(covariance))
    off = (weights @ z - mean) / sd
    assert np.abs(off).max() < 4 / np.sqrt(effective)
    np.testing.assert_allclose(np.sqrt(weights @ (z - weights @ z) ** 2), sd, rtol=4 / np.sqrt(2 * effective))


def test_resampled_draws_are_the_posterior_s(gaussian_problem):
    """A guide without correlations, which is narrower than the posterior, is made exact."""
    mean, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    tree = svi.fit(gaussian_problem, 1, num_samples=1000, guide="diagonal", refine="psis")
    draws, effective = draws_of(tree), tree.attrs["effective_draws"]
    assert draws.shape == (1000, 2) and tree.attrs["num_weighed"] == 4000 and tree.attrs["k_hat"] < 0.7
    sd = np.sqrt(np.diag(covariance))
    assert np.abs((draws.mean(0) - mean) / sd).max() < 4 / np.sqrt(min(effective, 1000))
    np.testing.assert_allclose(np.cov(draws.T) / np.outer(sd, sd), covariance / np.outer(sd, sd), atol=0.15)
    assert "log_weight" not in tree.sample_stats and tree.sample_stats.loss.dims == ("step",)
    assert not unreliable(tree)


def test_draws_in_a_far_and_narrow_place_say_so(density):
    """Weights of a Gaussian that is too narrow have k-hat 1 - its variance over the posterior's, wherever it is."""
    drawn = approximation(density, 20.0, 0.01)
    assert drawn.k_hat > 0.7  # measured: 0.98
    close, _ = matched(density, drawn)
    center = close.weights @ close.z
    off = np.linalg.solve(density.scale, center - density.center)
    assert close.k_hat > 0.7 or np.linalg.norm(off) < 0.2


def test_draws_that_diverged_come_back_with_the_others(density):
    """Half of the draws cannot be simulated at first; where all are moved to the posterior they count again."""
    drawn = approximation(density, 4.0, 0.5)
    lost = replace(drawn, terms=np.where(np.arange(NUM)[:, None] % 2, -np.inf, drawn.terms))
    close, moves = matched(density, lost)
    assert moves > 0 and np.isfinite(close.log_weight).all() and close.effective > NUM / 4
    off = np.linalg.solve(density.scale, close.weights @ close.z - density.center)
    assert np.abs(off).max() < 4 / np.sqrt(close.effective)


def test_without_a_single_simulation_there_is_nothing_to_weigh(density):
    with pytest.raises(SimulationDiverged, match="of 50 draws"):
        Weighed.of(density, np.full((50, density.size), np.nan), np.zeros(50))


def test_effective_draws_are_those_of_the_weights(gaussian_problem):
    tree = laplace.fit(gaussian_problem, 0, num_samples=200, refine="psis")
    tree.attrs["effective_draws"] = 37.0
    assert all(row.ess == 37.0 and row.r_hat is None for row in summarize(tree))


def test_a_method_without_it_lists_its_options(gaussian_study):
    with pytest.raises(MethodNotApplicable, match="emcee: has no option 'refine'; allowed: num_samples"):
        fit(load_study(gaussian_study), "emcee", refine="psis")
