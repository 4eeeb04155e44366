"""The encoder of whole episodes, where their posteriors are known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from det2stoc_bayes.errors import SamplingFailed
from det2stoc_bayes.inference._cvae import Schedule
from det2stoc_bayes.inference._episode_encoder import EpisodeEncoder, episode_posteriors
from det2stoc_bayes.transitions import Scaling, Transitions

STEPS, SIZE, NOISE = 8, 24, 2.0
GAIN = np.random.default_rng(0).standard_normal((SIZE, 2)) * [1.0, 0.3]


def episodes(count, random):
    """z, transitions whose change is linear in it where the first state is 1, and the posteriors' moments."""
    z = random.standard_normal((count, 2))
    tells = (random.random((count, STEPS)) < 0.5).astype(float)
    change = tells[..., None] * (z @ GAIN.T)[:, None] + NOISE * random.standard_normal((count, STEPS, SIZE))
    state = np.concatenate([tells[..., None], random.standard_normal((count, STEPS, SIZE - 1))], -1)
    rows = count * STEPS
    made = Transitions(
        state.reshape(rows, SIZE),
        random.standard_normal((rows, 1)),
        change.reshape(rows, SIZE),
        np.repeat(np.arange(count), STEPS),
    )
    precision = np.eye(2) + tells.sum(1)[:, None, None] * GAIN.T @ GAIN / NOISE**2
    score = np.einsum("et,etc,cz->ez", tells, change, GAIN) / NOISE**2
    mean = np.linalg.solve(precision, score[..., None])[..., 0]
    return z, made, mean, np.linalg.inv(precision)


@pytest.fixture(scope="module")
def learned():
    """Of 300 episodes, from 2000 that were simulated."""
    random = np.random.default_rng(1)
    z, simulated, _, _ = episodes(2000, random)
    true, real, mean, covariance = episodes(300, random)
    given = real, simulated, np.repeat(z, STEPS, 0), Scaling.of(simulated), jax.random.key(0)
    return *episode_posteriors(*given, Schedule(1500, learning_rate=2e-3, batch=25)), true, mean, covariance


def test_an_episodes_posterior_is_learned(learned):
    """Dropout costs some of what well known z would have, and the covariance says so."""
    means, covariances, _, true, exact, covariance = learned
    variance, known = (np.einsum("eii->ei", c) for c in (covariances, covariance))
    off = np.sqrt(((means - exact) ** 2).mean(0) / known.mean(0))  # in sds of the exact posterior
    ratio = np.sqrt(variance.mean(0) / known.mean(0))
    assert (off < [1.0, 0.5]).all(), off
    assert (ratio > 0.95).all() and (ratio < [1.8, 1.3]).all(), ratio
    assert np.corrcoef(np.log(variance[:, 1]), np.log(known[:, 1]))[0, 1] > 0.7  # who tells more is heard more
    error = true - means
    pull = np.einsum("ei,eij,ej->", error, np.linalg.inv(covariances), error) / true.size
    assert 0.6 < pull < 1.2, pull


def test_transitions_add_up():
    """In whatever order they come; padding counts for nothing, and of no transition the prior is left."""
    random = np.random.default_rng(3)
    encoder = EpisodeEncoder(3, 2, 2, jax.random.key(1))
    x, y = (jnp.asarray(random.standard_normal((6, n)), jnp.float32) for n in (3, 2))
    weight = jnp.array([1.0, 1, 1, 1, 0, 0])
    order = jnp.array([3, 5, 0, 4, 2, 1])
    mean, precision = encoder(x[:4], y[:4], jnp.ones(4))
    for found in (encoder(x, y, weight), encoder(x[order], y[order], weight[order])):
        np.testing.assert_allclose(found[0], mean, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(found[1], precision, rtol=1e-4)
    assert (np.linalg.eigvalsh(precision) > 1.0).all()
    none = encoder(x, y, jnp.zeros(6))
    np.testing.assert_array_equal(none[0], 0.0)
    np.testing.assert_array_equal(none[1], np.eye(2))


def test_what_has_no_finite_loss_is_refused():
    z, simulated, _, _ = episodes(20, np.random.default_rng(2))
    broken = np.repeat(z, STEPS, 0) * np.nan
    with pytest.raises(SamplingFailed, match="no finite loss"):
        episode_posteriors(
            simulated, simulated, broken, Scaling.of(simulated), jax.random.key(0), Schedule(10, batch=5)
        )
