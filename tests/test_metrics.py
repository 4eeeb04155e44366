"""Metrics of predictive draws against closed forms."""

import numpy as np
import pytest
from scipy import stats

from det2stoc_bayes import metrics


@pytest.fixture(scope="module")
def draws():
    return np.random.default_rng(0).normal([1.0, -2.0], [0.5, 3.0], (20_000, 1, 2))


def test_the_matched_density_is_the_gaussian_of_the_draws_moments(draws):
    true = np.array([[1.2, 0.0]])
    expected = stats.norm.logpdf(true, [1.0, -2.0], [0.5, 3.0]).sum()
    assert metrics.matched_log_density(draws, true)[0] == pytest.approx(expected, abs=0.03)  # sd of the moments: 0.01


def test_a_point_mass_has_the_floor_as_its_sd():
    found = metrics.matched_log_density(np.ones((5, 1, 3)), np.ones((1, 3)), floor=1e-3)
    assert found[0] == pytest.approx(3 * stats.norm.logpdf(0.0, 0.0, 1e-3))


def test_a_mixture_averages_densities_and_not_their_logs():
    terms = np.log([[0.1, 1.0], [0.5, 3.0]])
    np.testing.assert_allclose(metrics.mixture_log_density(terms), np.log([0.3, 2.0]))


def test_the_energy_score_of_a_normal(draws):
    """Gneiting and Raftery 2007, eq. 22, for one dimension at the centre: sd (2 phi(0) - 1 / sqrt(pi))."""
    one = draws[:, :, :1]
    expected = 0.5 * (2 * stats.norm.pdf(0) - 1 / np.sqrt(np.pi))
    assert metrics.energy_score(one, np.array([[1.0]]))[0] == pytest.approx(expected, abs=0.01)


def test_ranks_of_right_draws_are_uniform():
    random = np.random.default_rng(1)
    draws, true = random.standard_normal((400, 3000, 1)), random.standard_normal((3000, 1))
    assert metrics.uniform_distance(metrics.pit(draws, true)[:, 0]) < 1.63 / np.sqrt(3000)  # 1 % of samples exceed it
    assert metrics.uniform_distance(metrics.pit(2 * draws, true)[:, 0]) > 0.1
    assert metrics.uniform_distance(metrics.pit(draws + 0.3, true)[:, 0]) > 0.1


def test_the_divergence_of_gaussians():
    x = np.linspace(-12, 12, 20_001)
    p, q = stats.norm(0.3, 0.7), stats.norm(-0.5, 1.6)
    expected = np.trapezoid(p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), x)
    assert metrics.gaussian_divergence(0.3, 0.7, -0.5, 1.6) == pytest.approx(expected, rel=1e-6)
