"""Calibration of Gaussian posteriors that are right, too narrow, or shifted."""

import numpy as np
import pytest
from scipy import stats

from det2stoc_bayes.coverage import (
    coverage_p_value,
    credibilities,
    detectable,
    expected_coverage,
    rank_p_values,
    ranks,
    uniform_p_values,
)

REPLICATIONS, DRAWS = 500, 199


def posteriors(seed, stretch=1.0, shift=0.0):
    """theta ~ N(0, 1), x | theta ~ N(theta, 1): theta | x ~ N(x / 2, 1 / 2)."""
    random = np.random.default_rng(seed)
    truth = random.standard_normal((REPLICATIONS, 2))
    x, sd = truth + random.standard_normal(truth.shape), np.sqrt(0.5)
    around = random.standard_normal((REPLICATIONS, DRAWS, 2))
    return x[:, None] / 2 + sd * (shift + stretch * around), truth, random


def p_values(*args, **options):
    draws, truth, random = posteriors(*args, **options)
    return rank_p_values(ranks(draws, truth), DRAWS).min() * 2, coverage_p_value(credibilities(draws, truth, random))


def test_right_posteriors_pass_as_often_as_p_values_say():
    found = np.array([p_values(seed) for seed in range(40)])
    assert ((found < 0.1).sum(0) <= 9).all()  # Binomial(40, 0.1) exceeds 9 once in 100
    assert (found > 0.5).sum(0).min() >= 10


@pytest.mark.parametrize("wrong", [{"stretch": 0.8}, {"shift": 0.3}])
def test_ranks_reject_narrow_and_shifted_posteriors(wrong):
    assert max(p_values(seed, **wrong)[0] for seed in range(3)) < 0.01


def test_tarp_rejects_narrow_posteriors():
    assert max(p_values(seed, stretch=0.6)[1] for seed in range(3)) < 0.01


def test_coverage_of_right_posteriors_is_the_level():
    draws, truth, random = posteriors(1)
    level = np.array([0.1, 0.5, 0.9])
    found = expected_coverage(credibilities(draws, truth, random), level)
    np.testing.assert_allclose(found, level, atol=4 * np.sqrt(0.25 / REPLICATIONS))


def test_draws_that_are_all_equal_have_ranks_all_the_same():
    draws, truth = np.zeros((40, 9, 1)), np.linspace(-1, 1, 40)[:, None]
    assert set(ranks(draws, truth)[:, 0]) == {0, 9}
    assert rank_p_values(ranks(draws, truth), 9)[0] < 1e-6


@pytest.mark.parametrize("count", [30, 100])
def test_what_so_many_replications_detect_is_found_in_four_of_five_cases(count):
    shift, factor = detectable(count, 0.002, np.random.default_rng(0))
    assert shift is not None and factor is not None
    truth = np.random.default_rng(1).standard_normal((200, count))
    for wrong in (truth + shift, truth * factor):
        found = np.mean(uniform_p_values(stats.norm.cdf(wrong).T) < 0.002)
        assert found == pytest.approx(0.8, abs=4 * np.sqrt(0.16 / 200))  # measured: 0.80 to 0.86


def test_few_replications_detect_no_narrowness():
    shift, factor = detectable(5, 0.002, np.random.default_rng(0))
    assert factor is None and shift is not None and shift > 2
