"""What a decoder says of whole episodes and of their population, where it is linear and the answer is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from det2stoc_bayes.inference._cvae import Cvae, standard_normal
from det2stoc_bayes.inference._episodes import Episodes, population_draws

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


def test_the_population_of_known_episodes():
    """Of 40 episodes that are known exactly: mean and sd as those of a normal sample."""
    sample = np.random.default_rng(1).normal([0.4, -1.0], [0.3, 0.8], (40, 2))
    mu, sigma = population_draws(sample, np.zeros((40, 2, 2)), jax.random.key(0))
    sd = sample.std(0, ddof=1)
    assert (np.abs(mu.mean(0) - sample.mean(0)) < 0.15 * sd / np.sqrt(40) * 3).all()
    np.testing.assert_allclose(mu.std(0), sd / np.sqrt(40), rtol=0.15)
    np.testing.assert_allclose(sigma.mean(0), sd, rtol=0.05)


def test_the_uncertainty_of_episodes_is_no_spread_of_the_population():
    random = np.random.default_rng(2)
    noise = 0.5
    sample = random.normal(0.0, 0.1, (60, 1)) + noise * random.standard_normal((60, 1))
    _, sigma = population_draws(sample, np.full((60, 1, 1), noise**2), jax.random.key(0))
    assert sigma.mean() < 0.3  # the pooled sd is 0.51
