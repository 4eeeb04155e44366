"""Distances between sets of draws against what is known of Gaussians."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from det2stoc_bayes import two_samples
from det2stoc_bayes.two_samples import gaussian_kl, mean_errors, sd_errors, sliced_wasserstein

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import two_samples_jax  # noqa: E402

NUM = 2000
BOTH = pytest.mark.parametrize("c2st", [two_samples.c2st, two_samples_jax.c2st], ids=["sklearn", "jax"])


def gaussian(seed, shift=0.0, scale=1.0, size=2):
    return shift + scale * np.random.default_rng(seed).standard_normal((NUM, size))


@BOTH
def test_none_tells_equal_distributions_apart(c2st):
    """An accuracy of 4000 guesses has a standard error of 0.008, and a fold lacks what the others have too much of."""
    assert abs(c2st(gaussian(0), gaussian(1)) - 0.5) < 5 * 0.008  # measured: 0.474


@BOTH
@pytest.mark.parametrize("shift", [0.5, 1.5])
def test_the_best_classifier_of_shifted_gaussians(c2st, shift):
    """Its accuracy is Phi(distance / 2)."""
    best = stats.norm.cdf(shift * np.sqrt(2) / 2)
    assert c2st(gaussian(0, shift), gaussian(1)) == pytest.approx(best, abs=3 * 0.008)


def test_pairs_at_once_are_as_each_alone():
    draws, reference = (np.stack([gaussian(s, shift) for shift in (0.0, 0.5, 1.5)]) for s in (0, 1))
    alone = [two_samples_jax.c2st(a, b) for a, b in zip(draws + 0.3, reference, strict=True)]
    np.testing.assert_allclose(two_samples_jax.c2sts(draws + 0.3, reference), alone, atol=0.004)
    assert np.ptp(alone) < 0.05 < abs(two_samples_jax.c2st(draws[2], reference[0]) - 0.5)


def test_of_unequal_sets_as_many_are_taken():
    c2st = two_samples.c2st
    assert abs(c2st(gaussian(0)[:500], gaussian(1)) - 0.5) < 3 * 0.016
    assert c2st(np.zeros((100, 2)), gaussian(1)) > 0.9


def test_sliced_wasserstein_of_a_shift():
    """A shift d in two dimensions is d |cos| in each direction: 2 d / pi in the mean; units are the reference's."""
    a, b = gaussian(0) * 5, gaussian(0) * 5
    a[:, 0] += 5 * 3.0
    assert sliced_wasserstein(a, b) == pytest.approx(3.0 * 2 / np.pi, rel=0.06)
    assert sliced_wasserstein(gaussian(0), gaussian(1)) < 0.1


def test_errors_of_moments():
    a, b = gaussian(0, 1.0, 2.0), gaussian(1)
    np.testing.assert_allclose(mean_errors(a, b), 1.0, atol=4 * np.sqrt(5 / NUM))
    np.testing.assert_allclose(sd_errors(a, b), 1.0, atol=0.15)


def test_kl_of_gaussians_has_its_closed_form():
    exact = np.array([0.3, -0.2]), np.array([[1.0, 0.4], [0.4, 0.5]])
    draws = np.random.default_rng(0).multivariate_normal(*exact, 100_000)
    assert gaussian_kl(draws, *exact) < 1e-4  # measured: 2e-5
    assert gaussian_kl(draws + [0.5, 0.0], *exact) == pytest.approx(
        0.5 * 0.25 * np.linalg.inv(exact[1])[0, 0], rel=0.05
    )
    wide = draws.mean(0) + 2 * (draws - draws.mean(0))
    assert gaussian_kl(wide, *exact) == pytest.approx(0.5 * (2 * 4 - 2 - 2 * np.log(4)), rel=0.02)
