"""Samplers against the closed form, each other, and calibration."""

import arviz as az
import numpy as np
import pytest
from scipy import stats

from det2stoc_bayes.inference import blackjax_nuts, laplace, nuts
from det2stoc_bayes.models import linear_gaussian

EXACT = ("blackjax_nuts", "emcee", "laplace", "nuts", "smc", "svi")  # on a Gaussian, whose guide svi's is
NAMES = ["gravity_x", "gravity_z"]


def check_against_closed_form(tree, problem):
    mean, covariance = linear_gaussian.exact_posterior(problem)
    draws = np.stack([tree.posterior[n].values for n in NAMES], -1)
    for i, name in enumerate(NAMES):
        posterior = tree.posterior.to_dataset()[[name]]
        assert float(az.ess(posterior)[name]) > 300
        error = float(az.mcse(posterior)[name])
        assert abs(float(posterior[name].mean()) - mean[i]) < 3 * error
        sd_error = float(az.mcse(posterior, method="sd")[name])
        assert abs(float(posterior[name].std()) - np.sqrt(covariance[i, i])) < 3 * sd_error
    correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert abs(np.corrcoef(draws.reshape(-1, 2).T)[0, 1] - correlation) < 0.1


@pytest.mark.parametrize("name", EXACT)
def test_closed_form(name, fits, gaussian_problem):
    check_against_closed_form(fits(name), gaussian_problem)


@pytest.mark.parametrize("pair", [("nuts", "blackjax_nuts"), ("nuts", "emcee"), ("blackjax_nuts", "emcee")])
def test_samplers_agree(pair, fits):
    trees = [fits(name) for name in pair]
    for name in NAMES:
        means = [float(t.posterior[name].mean()) for t in trees]
        errors = [float(az.mcse(t.posterior)[name]) for t in trees]
        assert abs(means[0] - means[1]) < 3 * np.hypot(*errors)


def test_nuts_is_well_tuned(fits):
    for name in ("nuts", "blackjax_nuts"):
        stats = fits(name).sample_stats
        assert not stats.diverging.any()
        assert 0.6 < float(stats.acceptance_rate.mean()) < 0.98
        assert float(stats.n_steps.mean()) < 10
        assert max(float(v) for v in az.rhat(fits(name).posterior).values()) < 1.02


@pytest.mark.parametrize(
    "method", [pytest.param(nuts, marks=pytest.mark.long), blackjax_nuts], ids=["nuts", "blackjax_nuts"]
)
def test_many_chains_are_unbiased(method, gaussian_problem):
    """Standard errors from independent chains: no estimate of autocorrelation can flatter them."""
    tree = method.fit(gaussian_problem, 3, num_samples=64 * 60, num_chains=64)
    mean, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    draws = np.stack([tree.posterior[n].values for n in NAMES], -1) - mean
    root = np.linalg.cholesky(np.linalg.inv(covariance))
    u = draws @ root
    for moment, expected in ((u.mean(1), 0.0), ((u**2).mean(1), 1.0)):
        error = moment.std(0, ddof=1) / np.sqrt(len(moment))
        assert (np.abs(moment.mean(0) - expected) < 3.5 * error).all()


def test_emcee_runs_long_enough(fits):
    stats = fits("emcee").sample_stats
    assert bool(stats.converged)
    assert int(stats.steps) > 50 * float(stats.autocorrelation_time.max())


def test_finite_differences_sample_the_same(fits, gaussian_problem):
    tree = nuts.fit(gaussian_problem, 1, num_samples=200, gradient="finite")
    for name in NAMES:
        errors = [float(az.mcse(t.posterior)[name]) for t in (tree, fits("nuts"))]
        difference = float(tree.posterior[name].mean() - fits("nuts").posterior[name].mean())
        assert abs(difference) < 3 * np.hypot(*errors)


@pytest.mark.long
def test_nuts_with_mjx(gaussian_problem_mjx):
    tree = nuts.fit(gaussian_problem_mjx, 1, num_samples=600)
    assert tree.attrs["engine"] == "mjx"
    assert tree.attrs["gradients"] > 600
    check_against_closed_form(tree, gaussian_problem_mjx)


@pytest.mark.long
def test_laplace_is_calibrated(gaussian_problem):
    """Gravity drawn from the prior ranks uniformly among the posterior's draws."""
    random, setting = np.random.default_rng(7), linear_gaussian.Setting()
    ranks = []
    for replication in range(100):
        gravity = linear_gaussian.draw_gravity(random, setting)
        recordings = linear_gaussian.simulate(gravity, random, setting)
        problem = linear_gaussian.with_recordings(gaussian_problem, recordings)
        posterior = laplace.fit(problem, replication, num_samples=100).posterior
        ranks.append([float((posterior[n] < g).mean()) for n, g in zip(NAMES, gravity, strict=True)])
    for column in np.array(ranks).T:
        counts = np.histogram(column, bins=10, range=(0, 1.000001))[0]
        assert stats.chisquare(counts).pvalue > 0.01
