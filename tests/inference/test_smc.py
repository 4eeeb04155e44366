"""Tempered particles where a Gaussian at the mode fails."""

import numpy as np
import pytest
from scipy import stats

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.errors import MethodNotApplicable, SamplingFailed
from det2stoc_bayes.inference import smc
from det2stoc_bayes.inference._tempering import Tempering, chain_length
from det2stoc_bayes.inference.smc import temper
from det2stoc_bayes.psis import smooth

CENTRES, SD = np.array([[-1.5, 0.0], [1.5, 1.0]]), 0.2
SHARES = np.array([0.3, 0.7])


def two_modes(z):
    parts = [np.log(w) + stats.multivariate_normal(c, SD**2).logpdf(z) for w, c in zip(SHARES, CENTRES, strict=True)]
    return np.logaddexp(*parts)


def banana(z):
    """x normal, y normal about x^2."""
    return stats.norm.logpdf(z[:, 0]) + stats.norm.logpdf(z[:, 1], z[:, 0] ** 2, 0.3)


def k_hat(log_target, centre, covariance, random):
    gaussian = stats.multivariate_normal(centre, covariance)
    z = gaussian.rvs(4000, random_state=random)
    return smooth(log_target(z) - gaussian.logpdf(z))[1]


def prior_draws(random, count=2000):
    return random.standard_normal((count, 2))


def test_two_modes():
    random = np.random.default_rng(0)
    # Seen from the larger mode all is well: a Gaussian there does not know that it missed 30 %.
    moved = temper(log_prior, two_modes, prior_draws(random), 1)
    right = moved.particles[:, 0] > 0
    assert right.mean() == pytest.approx(0.7, abs=0.05)
    for side, centre in ((~right, CENTRES[0]), (right, CENTRES[1])):
        here = moved.particles[side]
        np.testing.assert_allclose(here.mean(0), centre, atol=4 * SD / np.sqrt(side.sum()) * 1.5)
        np.testing.assert_allclose(here.std(0), SD, rtol=0.12)
    assert moved.log_evidence == pytest.approx(0.0, abs=0.15)
    assert moved.tempering[-1] == 1.0 and all(np.diff((0.0, *moved.tempering)) > 0)
    assert min(moved.acceptance) > 0.05  # measured: 0.095; the walk's steps span both modes


def test_banana_that_laplace_fails():
    random = np.random.default_rng(1)
    # At the mode (0, 0) the curvature in y is that of a straight ridge.
    assert k_hat(banana, np.zeros(2), np.diag([1.0, 0.09]), random) > 0.7
    moved = temper(lambda z: log_prior(z / 2) - 2 * np.log(2), banana, 2 * prior_draws(random), 2)
    x, y = moved.particles.T
    assert stats.kstest(x, "norm").pvalue > 0.001
    assert stats.kstest((y - x**2) / 0.3, "norm").pvalue > 0.001
    assert y.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2.09 / 2000) * 1.5)
    assert moved.log_evidence == pytest.approx(0.0, abs=0.15)


def test_same_key_same_particles():
    particles = prior_draws(np.random.default_rng(3), 200)
    a, b = (temper(log_prior, two_modes, particles, 4).particles for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_where_it_does_not_arrive():
    particles = prior_draws(np.random.default_rng(3), 50)
    with pytest.raises(SamplingFailed, match="of 2 stages"):
        temper(log_prior, lambda z: -1e6 * (z**2).sum(1), particles, 0, max_stages=2)


def test_diverged_simulations_have_no_weight():
    def half(z):
        return np.where(z[:, 0] > 0, log_prior(z), -np.inf)

    moved = temper(log_prior, half, prior_draws(np.random.default_rng(5)), 5)
    assert (moved.particles[:, 0] > 0).all()
    assert moved.log_evidence == pytest.approx(np.log(0.5), abs=0.1)


@pytest.mark.long
def test_from_the_mode_it_is_the_same_posterior(gaussian_problem, fits):
    cheap = smc.fit(gaussian_problem, 3, initial="mode")
    assert cheap.sample_stats.tempering.sizes["stage"] < fits("smc").sample_stats.tempering.sizes["stage"]
    for name, draws in fits("smc").posterior.items():
        sd = float(draws.std())
        assert abs(float(cheap.posterior[name].mean() - draws.mean())) < 4 * sd * np.sqrt(2 / 1000)
        assert float(cheap.posterior[name].std()) == pytest.approx(sd, rel=0.12)


@pytest.mark.parametrize(("count", "length"), [(1000, 10), (250, 10), (100, 5), (1004, 4), (1999, 1), (24, 1)])
def test_chains_divide_the_particles_and_are_many(count, length):
    assert chain_length(count) == length and count % length == 0
    moved = temper(log_prior, banana, prior_draws(np.random.default_rng(1), count), 1, waste_free=True)
    assert len(moved.particles) == count and min(moved.acceptance) > 0


@pytest.mark.parametrize(("options", "arrived"), [({}, True), ({"num_moves": 1, "target_ess": 0.01}, False)])
def test_groups_disagree_until_they_have_arrived(options, arrived):
    """They know nothing of each other, so R-hat is as of chains: of six keys 1.009 at most, and in haste 85 or more."""
    narrow = stats.multivariate_normal(np.full(3, 1.0), 0.02**2)
    way = Tempering(log_prior, lambda z: np.reshape(narrow.logpdf(z), len(z)), 100, **options)
    first = np.random.default_rng(0).standard_normal((4, 100, 3))
    z = np.stack([way.run(group, k).particles for k, group in enumerate(first)])
    assert (r_hat(z) < 1.05) == arrived


@pytest.mark.parametrize(("waste_free", "arrived"), [(False, True), (True, False)])
def test_short_chains_do_not_forget_in_many_directions(waste_free, arrived):
    """Of 20 unknowns: measured R-hat of three keys 1.38 to 2.48 waste-free, and 1.003 where all particles move."""
    narrow = stats.multivariate_normal(np.full(20, 0.5), 0.05**2)
    way = Tempering(log_prior, lambda z: np.reshape(narrow.logpdf(z), len(z)), 400, waste_free=waste_free)
    first = np.random.default_rng(0).standard_normal((4, 400, 20))
    z = np.stack([way.run(group, k, num_last=20).particles for k, group in enumerate(first)])
    assert (r_hat(z) < 1.05) == arrived


@pytest.mark.parametrize(("size", "moves"), [(1, 5), (6, 5), (17, 6), (36, 11)])
def test_more_unknowns_take_more_moves(size, moves):
    assert smc.moves_for(size) == moves


def r_hat(z):
    """Of chains of equal length (Gelman and Rubin 1992), the worst unknown's."""
    within, between = z.var(1, ddof=1).mean(0), z.mean(1).var(0, ddof=1)
    return np.sqrt(1 - 1 / z.shape[1] + between / within).max()


@pytest.mark.parametrize(
    ("options", "said"), [({"num_moves": 0}, "num_moves = 0"), ({"num_samples": 8}, "40 at least")]
)
def test_too_little_is_refused(gaussian_problem, options, said):
    with pytest.raises(MethodNotApplicable, match=said):
        smc.fit(gaussian_problem, 0, **options)


def test_chains_that_keep_their_states_take_fewer_densities():
    """A narrow, correlated Gaussian in closed form: the same particles for a third of the densities."""
    root = 0.01 * (np.random.default_rng(9).standard_normal((3, 3)) + np.eye(3))
    centre, sd = np.full(3, 0.5), np.sqrt((root**2).sum(1))
    counted, found = {}, {}
    for waste_free in (False, True):
        asked = []

        def target(z, asked=asked):
            asked.append(len(z))
            return stats.multivariate_normal(centre, root @ root.T).logpdf(z).reshape(len(z))

        first = np.random.default_rng(1).standard_normal((2000, 3))
        found[waste_free] = temper(log_prior, target, first, 1, num_last=3, waste_free=waste_free)
        counted[waste_free] = sum(asked)
    assert counted[True] < 0.45 * counted[False]  # measured: 0.32
    moved = found[True]
    assert len(moved.particles) == 2000
    # Of six keys the worst: 0.041, 0.029 and 0.34 nats (0.057, 0.041 and 0.16 where each move is but a step).
    np.testing.assert_allclose((moved.particles.mean(0) - centre) / sd, 0.0, atol=0.12)
    np.testing.assert_allclose(moved.particles.std(0) / sd, 1.0, atol=0.08)
    assert moved.log_evidence == pytest.approx(0.0, abs=0.8)
