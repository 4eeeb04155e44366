"""The CVAE against a linear-Gaussian latent model, whose evidence and posterior of z are known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from jaxtyping import Array

from det2stoc_bayes.inference._cvae import Cvae, HybridELBO, Schedule, optimize, standard_normal
from det2stoc_bayes.inference._networks import Decoder, Encoder

GAIN = np.array([[1.0, 0.4], [-0.5, 0.8], [0.2, -0.6]])  # y's on z
SHIFT = np.array([[0.7], [0.0], [-0.3]])  # y's on x
NOISE = 0.5
PRECISION = np.eye(2) + GAIN.T @ GAIN / NOISE**2
COVARIANCE = np.linalg.inv(PRECISION)


class LinearDecoder(eqx.Module):
    """y = GAIN z + SHIFT x + noise."""

    gain: Array

    def __call__(self, x, z):
        return self.gain @ z + jnp.asarray(SHIFT) @ x, jnp.full(3, NOISE)


class ExactEncoder(eqx.Module):
    """The posterior of z."""

    scale: Array

    def __call__(self, x, y, key=None):
        return jnp.asarray(COVARIANCE @ GAIN.T / NOISE**2) @ (y - jnp.asarray(SHIFT) @ x), self.scale


def data(count, seed=0):
    random = np.random.default_rng(seed)
    x, z = random.standard_normal((count, 1)), random.standard_normal((count, 2))
    y = z @ GAIN.T + x @ SHIFT.T + NOISE * random.standard_normal((count, 3))
    return jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)


def exact(frozen=True):
    factor = jnp.asarray(np.linalg.cholesky(COVARIANCE))
    return Cvae(ExactEncoder(factor), LinearDecoder(jnp.asarray(GAIN)), standard_normal(2), frozen)


def test_with_the_exact_posterior_the_bound_is_the_evidence():
    x, y = data(50)
    cvae, elbo = exact(), HybridELBO(1.0)
    params = {"encoder$params": eqx.filter(cvae.encoder, eqx.is_array)}
    loss = elbo.loss(jax.random.key(0), params, cvae.model, cvae.guide, x, y)
    evidence = dist.MultivariateNormal(x @ SHIFT.T, GAIN @ GAIN.T + NOISE**2 * np.eye(3)).log_prob(y).sum()
    assert -float(np.asarray(loss)) == pytest.approx(float(evidence), rel=1e-5)


def test_without_the_bound_it_is_the_expectation_over_the_prior():
    x, y = data(20)
    cvae = exact()
    params = {"encoder$params": eqx.filter(cvae.encoder, eqx.is_array)}
    elbo = HybridELBO(0.0)
    loss = jax.jit(lambda key: elbo.loss(key, params, cvae.model, cvae.guide, x, y))
    values = [-float(loss(key)) for key in jax.random.split(jax.random.key(0), 400)]
    off = np.asarray(y - x @ SHIFT.T)
    each = -0.5 * (off**2 + (GAIN**2).sum(1)) / NOISE**2 - np.log(NOISE * np.sqrt(2 * np.pi))
    assert abs(np.mean(values) - each.sum()) < 4 * np.std(values) / np.sqrt(len(values))


@pytest.mark.parametrize("full", [False, True])
def test_q_learns_the_exact_posterior_under_a_frozen_decoder(full):
    cvae = Cvae(
        Encoder(1, 3, 2, jax.random.key(1), drop=0.0, full=full),
        LinearDecoder(jnp.asarray(GAIN)),
        standard_normal(2),
        True,
    )
    schedule = Schedule(1500, learning_rate=5e-3, batch=300, checks=10)
    params, _ = optimize(
        HybridELBO(1.0), cvae.model, cvae.guide, data(20_000), data(2000, 1), jax.random.key(2), schedule
    )
    assert set(params) == {"encoder$params"}  # the decoder is no parameter
    x, y = data(500, 3)
    mean, scale = jax.vmap(cvae.with_params(params).encoder)(x, y)
    expected = (np.asarray(y) - np.asarray(x) @ SHIFT.T) @ GAIN @ COVARIANCE / NOISE**2
    wanted = np.linalg.cholesky(COVARIANCE) if full else np.diag(PRECISION) ** -0.5
    sd = np.sqrt(np.diag(COVARIANCE))
    # A diagonal q that minimizes KL(q || p) has the posterior's mean and its conditional sds.
    assert (np.sqrt(np.mean((mean - expected) ** 2, 0)) / sd < 0.1).all()  # measured: 0.03, full 0.04
    assert np.abs(np.asarray(scale).mean(0) - wanted).max() < 0.05 * sd.min()  # measured: 0.006, full 0.02


def test_a_decoder_is_learned_from_simulations_with_psi_in_the_place_of_z():
    x, y = data(20_000)
    random = np.random.default_rng(5)
    z = jnp.asarray(random.standard_normal((20_000, 2)), jnp.float32)
    y = jnp.asarray(
        np.asarray(z) @ GAIN.T + np.asarray(x) @ SHIFT.T + NOISE * random.standard_normal(y.shape), jnp.float32
    )
    cvae = Cvae(Encoder(1, 3, 2, jax.random.key(0)), Decoder(1, 2, 3, jax.random.key(1)), standard_normal(2), False)
    held = tuple(a[:1000] for a in (x, y, z))
    learned = tuple(a[1000:] for a in (x, y, z))
    schedule = Schedule(1500, learning_rate=5e-3, batch=300, checks=10)
    params, history = optimize(HybridELBO(1.0), cvae.model, cvae.guide, learned, held, jax.random.key(2), schedule)
    assert set(params) == {"decoder$params"}  # nothing is recognized
    entropy = 1.5 * np.log(2 * np.pi * np.e * NOISE**2)
    assert history[-1][2] == pytest.approx(entropy, abs=0.08)  # measured: 0.02 above
    mean, sd = jax.vmap(cvae.with_params(params).decoder)(held[0], held[2])
    assert np.abs(mean - (held[2] @ GAIN.T + held[0] @ SHIFT.T)).mean() < 0.08 * NOISE * 2  # measured: 0.03
    assert np.asarray(sd).mean() == pytest.approx(NOISE, rel=0.03)


def test_training_ends_early_and_keeps_the_best():
    x, y = data(300)
    encoder = Encoder(1, 3, 2, jax.random.key(0), drop=0.0)
    cvae = Cvae(encoder, Decoder(1, 2, 3, jax.random.key(1)), standard_normal(2), False)
    schedule = Schedule(20_000, learning_rate=1e-2, batch=100, checks=100, patience=3)
    learned, held = (x[:100], y[:100]), (x[100:], y[100:])
    _, history = optimize(HybridELBO(1.0), cvae.model, cvae.guide, learned, held, jax.random.key(1), schedule)
    judged = [value for _, _, value in history]
    best, last = history[int(np.argmin(judged))][0], history[-1][0]
    assert last < 20_000  # it over-fits
    assert last - best == 3 * 200


@pytest.mark.parametrize(
    ("options", "rows", "steps"),
    [
        ({}, 100_000, 300), ({}, 800, 10), ({}, 8000, 80), ({}, 1, 10), ({"epochs": np.inf}, 800, 300),
        ({"num_steps": 20}, 800, 1), ({"num_steps": 0}, 800, 1), ({"epochs": 0.1}, 2000, 1),
    ],
)  # fmt: skip
def test_training_is_looked_at_every_so_many_steps(options, rows, steps):
    schedule = Schedule(**{"num_steps": 12_000, "batch": 1000} | options)
    assert schedule.steps_between_checks(rows) == steps


@pytest.mark.parametrize(("epochs", "in_time"), [(10.0, True), (np.inf, False)])
def test_few_rows_are_not_learned_by_heart(epochs, in_time):
    """Loss beyond the entropy, measured: 0.47 nats, and where only every fortieth of the steps is checked 39."""
    x, y = data(150)
    encoder = Encoder(1, 3, 2, jax.random.key(0), drop=0.0)
    z = jnp.asarray(np.random.default_rng(5).standard_normal((150, 2)), jnp.float32)
    y = jnp.asarray(np.asarray(z) @ GAIN.T + NOISE * np.random.default_rng(6).standard_normal(y.shape), jnp.float32)
    cvae = Cvae(encoder, Decoder(1, 2, 3, jax.random.key(1)), standard_normal(2), False)
    schedule = Schedule(12_000, learning_rate=5e-3, batch=100, epochs=epochs)
    learned, held = (tuple(a[rows] for a in (x, y, z)) for rows in (slice(100), slice(100, None)))
    _, history = optimize(HybridELBO(1.0), cvae.model, cvae.guide, learned, held, jax.random.key(2), schedule)
    best = min(value for _, _, value in history) - 1.5 * np.log(2 * np.pi * np.e * NOISE**2)
    assert (best < 1.0) == in_time


def test_scales_are_lower_triangular_with_positive_diagonals():
    decoder = Decoder(2, 1, 3, jax.random.key(0), full=True)
    mean, scale = decoder(jnp.ones(2, jnp.float32), jnp.ones(1, jnp.float32))
    assert mean.shape == (3,)
    assert scale.shape == (3, 3)
    np.testing.assert_array_equal(scale, np.tril(scale))
    assert (np.diag(scale) > 0).all()


def test_every_layer_sees_the_latent():
    decoder = Decoder(2, 1, 3, jax.random.key(0))
    for k in range(4):
        layers = [*decoder.net.layers, decoder.net.last]
        blind = [eqx.tree_at(lambda n: n.weight, n, n.weight.at[:, -1].set(0.0)) for n in layers]
        kept = [n if i == k else b for i, (n, b) in enumerate(zip(layers, blind, strict=True))]
        one = eqx.tree_at(lambda d: (d.net.layers, d.net.last), decoder, (tuple(kept[:-1]), kept[-1]))
        slope = jax.jacobian(lambda z, one=one: one(jnp.ones(2, jnp.float32), z)[0])(jnp.ones(1, jnp.float32))
        assert np.abs(slope).max() > 1e-3
