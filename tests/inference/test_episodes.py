"""What a decoder says of whole episodes and of their population, where it is linear and the answer is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from det2stoc_bayes.inference._cvae import Cvae, standard_normal
from det2stoc_bayes.inference._episodes import Episodes, _fisher, log_marginal, population_draws

GAIN = np.array([[1.0, 0.4], [-0.5, 0.8], [0.2, -0.6]], np.float32)
NOISE = 0.5


class LinearDecoder(eqx.Module):
    """y = x1 GAIN z + noise: some transitions tell more than others."""

    def __call__(self, x, z):
        return x[0] * (jnp.asarray(GAIN) @ z), jnp.full(3, NOISE, jnp.float32)


class Blind(eqx.Module):
    """An encoder that knows nothing."""

    def __call__(self, x, y, key=None):
        return jnp.zeros(2, jnp.float32), jnp.ones(2, jnp.float32)


@pytest.fixture(scope="module")
def data():
    random = np.random.default_rng(0)
    episode = np.repeat(np.arange(6), [9, 4, 7, 9, 2, 5])
    x, z = random.standard_normal((len(episode), 1)), random.standard_normal((6, 2))
    y = x * (z[episode] @ GAIN.T) + NOISE * random.standard_normal((len(episode), 3))
    return x.astype(np.float32), y.astype(np.float32), episode


def test_an_episode_has_one_latent(data):
    x, y, episode = data
    cvae = Cvae(Blind(), LinearDecoder(), standard_normal(2), True)
    means, covariances = Episodes.of(cvae, x, y, episode).posteriors()
    for e in range(6):
        weight = x[episode == e, 0]
        precision = np.eye(2) + (weight**2).sum() * GAIN.T @ GAIN / NOISE**2
        expected = np.linalg.solve(precision, GAIN.T @ (weight @ y[episode == e]) / NOISE**2)
        np.testing.assert_allclose(means[e], expected, atol=2e-4)
        np.testing.assert_allclose(covariances[e], np.linalg.inv(precision), rtol=1e-3, atol=1e-5)


def posterior_of(sample, noise):
    """Of episodes measured with noise, under the reference prior N(0, I)."""
    variance = noise**2 / (1 + noise**2)
    return sample / (1 + noise**2), np.tile(variance * np.eye(sample.shape[1]), (len(sample), 1, 1))


def test_the_population_of_known_episodes():
    """Of 40 episodes that are known all but exactly: mean and sd as those of a normal sample."""
    sample = np.random.default_rng(1).normal([0.4, -1.0], [0.3, 0.8], (40, 2))
    mu, sigma = population_draws(*posterior_of(sample, 1e-3), jax.random.key(0))
    sd = sample.std(0, ddof=1)
    assert (np.abs(mu.mean(0) - sample.mean(0)) < 0.15 * sd / np.sqrt(40) * 3).all()
    np.testing.assert_allclose(mu.std(0), sd / np.sqrt(40), rtol=0.15)
    np.testing.assert_allclose(sigma.mean(0), sd, rtol=0.05)


def test_the_uncertainty_of_episodes_is_no_spread_of_the_population():
    random = np.random.default_rng(2)
    noise = 0.5
    sample = random.normal(0.0, 0.1, (60, 1)) + noise * random.standard_normal((60, 1))
    _, sigma = population_draws(*posterior_of(sample, noise), jax.random.key(0))
    assert sigma.mean() < 0.3  # the pooled sd is 0.51


def test_episodes_that_tell_nothing_leave_the_population_s_prior():
    """The reference prior of every episode is taken out again, ten times here."""
    mu, sigma = population_draws(*posterior_of(np.zeros((10, 2)), 1e6), jax.random.key(0), 4000)
    np.testing.assert_allclose(mu.mean(0), 0.0, atol=0.4)  # 4 standard errors of some 1000 effective draws
    np.testing.assert_allclose(mu.std(0), 3.0, rtol=0.1)
    np.testing.assert_allclose((sigma**2).mean(0), 1.0, rtol=0.25)


def test_one_value_for_all_episodes():
    """Where z does not vary: the mean's posterior is that of the measurements together, N(0, 3) before them."""
    random, noise = np.random.default_rng(3), 0.5
    sample = 0.7 + noise * random.standard_normal((8, 1))
    mu, sigma = population_draws(*posterior_of(sample, noise), jax.random.key(0), 4000, np.array([False]))
    precision = 8 / noise**2 + 1 / 9
    assert (sigma == 0).all()
    assert mu.mean() == pytest.approx(sample.sum() / noise**2 / precision, abs=0.02)
    assert mu.std() == pytest.approx(precision**-0.5, rel=0.1)


def test_the_marginal_is_the_integral_over_z():
    random = np.random.default_rng(4)
    mu, spread, score = np.array([0.3]), np.array([0.8]), random.standard_normal((3, 1))
    information = np.array([0.0, 0.5, 20.0])[:, None, None]
    z = np.linspace(-8, 8, 20_001)
    inside = stats.norm.pdf(z, mu, spread) * np.exp(score * z - 0.5 * information[:, 0] * z**2)
    with jax.enable_x64(True):
        found = log_marginal(*map(jnp.asarray, (mu, spread, score, information)))
    np.testing.assert_allclose(found, np.log(inside.sum(1) * (z[1] - z[0])), rtol=1e-9)


def test_information_in_a_full_covariance():
    """A decoder whose scale alone depends on z: Fisher's information of a normal's covariance, by differences."""

    class Scaled(eqx.Module):
        def __call__(self, x, z):
            return jnp.zeros(2), jnp.array([[jnp.exp(z[0]), 0.0], [z[1], 1.0]])

    def covariance(z):
        root = np.array([[np.exp(z[0]), 0.0], [z[1], 1.0]])
        return root @ root.T

    z, h = np.array([0.2, 0.5]), 1e-5
    slopes = [(covariance(z + h * e) - covariance(z - h * e)) / (2 * h) for e in np.eye(2)]
    inverse = np.linalg.inv(covariance(z))
    expected = [[0.5 * np.trace(inverse @ a @ inverse @ b) for b in slopes] for a in slopes]
    found = _fisher(Scaled(), jnp.asarray(z), jnp.zeros((1, 1)), jnp.ones(1))
    np.testing.assert_allclose(found, np.eye(2) + expected, rtol=1e-4)
