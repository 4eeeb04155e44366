"""Priors against scipy and NumPyro, and their maps from a standard normal number."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special, stats

from det2stoc_bayes.errors import StudyError
from det2stoc_bayes.priors import FAMILIES, Prior

PRIORS = [
    Prior.parse({family: arguments}, "here")
    for family, arguments in [
        ("Normal", {"loc": 1, "scale": 2}),
        ("TruncatedNormal", {"loc": 0.25, "scale": 0.1, "low": 0.1, "high": 0.4}),
        ("TruncatedNormal", {"loc": 1e-4, "scale": 2e-4, "low": 0.0}),
        ("TruncatedNormal", {"loc": -0.04, "scale": 0.01, "high": 0.0}),
        ("TruncatedNormal", {"loc": 0.0, "scale": 1.0, "low": 8.0, "high": 10.0}),
        ("TruncatedNormal", {"loc": 0.0, "scale": 1.0, "high": -12.0}),
        ("TruncatedNormal", {"loc": 3.0}),
        ("HalfNormal", {"scale": 2}),
        ("Uniform", {"low": -1, "high": 3}),
        ("LogNormal", {"loc": 0.5, "scale": 0.7}),
        ("LogUniform", {"low": 1e-3, "high": 10}),
        ("Exponential", {"rate": 2}),
        ("Laplace", {"loc": 1, "scale": 2}),
        ("Cauchy", {"loc": 1, "scale": 2}),
        ("HalfCauchy", {"scale": 2}),
        ("Logistic", {"loc": 1, "scale": 2}),
        ("Gumbel", {"loc": 1, "scale": 2}),
        ("Gamma", {"concentration": 2.5, "rate": 3}),
        ("Gamma", {"concentration": 0.1}),
        ("InverseGamma", {"concentration": 2.5, "rate": 3}),
        ("Beta", {"concentration1": 2, "concentration0": 0.7}),
        ("Beta", {"concentration1": 40, "concentration0": 300}),
        ("StudentT", {"df": 4, "loc": 1, "scale": 2}),
        ("StudentT", {"df": 1.0}),
    ]
]
every_prior = pytest.mark.parametrize("prior", PRIORS, ids=str)
TABULATED = ("Gamma", "InverseGamma", "Beta", "StudentT")


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def test_every_family_is_tested():
    assert {prior.family for prior in PRIORS} == set(FAMILIES)


def quantile(prior: Prior, z: np.ndarray) -> np.ndarray:
    """scipy's, from the nearer tail."""
    return np.where(z < 0, prior._scipy.ppf(special.ndtr(z)), prior._scipy.isf(special.ndtr(-z)))


@every_prior
def test_is_scipys_quantile(prior: Prior):
    z = np.linspace(-5, 5, 201)
    expected = quantile(prior, z)
    typical = np.median(np.abs(expected - np.median(expected)))
    # scipy's own truncated normal has 1e-8 far in the tail.
    np.testing.assert_allclose(prior.from_normal(z), expected, rtol=1e-7, atol=1e-10 * typical)


@every_prior
def test_is_numpyros_distribution(prior: Prior):
    z = np.linspace(-4, 4, 41)
    x = prior.from_normal(z)
    distribution = prior.distribution
    if prior.arguments.get("low", 0) == 8 or prior.arguments.get("high", 0) == -12:
        return  # NumPyro's own normalisation has no digits left so far out
    np.testing.assert_allclose(prior.log_prob(x), distribution.log_prob(jnp.asarray(x)), rtol=1e-6, atol=1e-6)
    try:
        numpyros = distribution.icdf(jnp.asarray(special.ndtr(z)))
    except (NotImplementedError, ImportError):
        return  # the families whose quantile NumPyro leaves to another package
    typical = np.median(np.abs(x - np.median(x)))
    if prior.arguments.get("low", 0) < 8 and prior.arguments.get("high", 0) > -12:  # there NumPyro's own saturates
        np.testing.assert_allclose(x, numpyros, rtol=1e-5, atol=1e-7 * typical)


@every_prior
def test_numpyro_and_scipy_agree_on_moments_and_support(prior: Prior):
    draws = prior.from_normal(np.random.default_rng(0).normal(size=20_000))
    low, high = prior.support
    assert low <= draws.min() and draws.max() <= high
    finite_sd = math.isfinite(prior.sd) and not (prior.family == "Gamma" and prior.arguments["concentration"] < 1)
    if finite_sd:
        assert abs(draws.mean() - prior.mean) < 5 * prior.sd / math.sqrt(len(draws))
    if prior.family in ("Cauchy", "HalfCauchy"):
        assert not math.isfinite(prior.mean) or not math.isfinite(prior.sd)


@every_prior
def test_both_libraries_are_monotone_finite_and_equal_far_out(prior: Prior):
    z = np.linspace(-30, 30, 6001)
    with np.errstate(all="raise", under="ignore"):
        x = prior.from_normal(z)
    by_jax = np.asarray(prior.from_normal(jnp.asarray(z), jnp))
    low, high = prior.support
    for values in (x, by_jax):
        assert np.isfinite(values).all() and (low <= values).all() and (values <= high).all()
        rising = np.diff(values)
        assert (rising >= -1e-15 * np.abs(values[1:])).all()
        assert (rising[1000:5000] >= 0).all()
    np.testing.assert_allclose(by_jax, x, rtol=1e-8, atol=1e-14)


@every_prior
def test_gradients_are_finite_and_right(prior: Prior):
    gradient = jax.vmap(jax.grad(lambda z: prior.from_normal(z, jnp)))
    forward = jax.vmap(jax.jacfwd(lambda z: prior.from_normal(z, jnp)))
    far = np.r_[np.linspace(-30, 30, 121), 0.0]
    assert np.isfinite(gradient(far)).all() and (np.asarray(gradient(far)) >= 0).all()
    np.testing.assert_allclose(gradient(far), forward(far), rtol=1e-12, atol=1e-300)
    z = np.linspace(-4, 4, 80)  # 0 itself, where a Laplace has a kink in its slope, is between
    h = 1e-5
    numeric = (prior.from_normal(z + h) - prior.from_normal(z - h)) / (2 * h)
    np.testing.assert_allclose(gradient(z), numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())


@every_prior
@settings(max_examples=40, deadline=None)
@given(z=st.floats(-6, 6))
def test_round_trip(prior: Prior, z: float):
    x = prior.from_normal(np.array(z))
    again = prior.from_normal(prior.to_normal(x))
    # In x, since close to a bound many z share one floating-point number.
    scale = max(abs(float(x)), np.ptp(prior.from_normal(np.array([-1.0, 1.0]))))
    assert abs(again - x) <= 1e-8 * scale
    slope = prior.from_normal(np.array(z) + 1e-3) - prior.from_normal(np.array(z) - 1e-3)
    if slope > 1e-6 * scale:
        assert abs(prior.to_normal(x) - z) < 1e-7


def test_no_saturation_at_eight_standard_deviations():
    bounded_below = Prior.parse({"TruncatedNormal": {"loc": 0.0, "scale": 1.0, "low": -1.0}}, "here")
    bounded_above = Prior.parse({"TruncatedNormal": {"loc": 0.0, "scale": 1.0, "high": 1.0}}, "here")
    z = np.array([8.0, 12.0, 20.0, 30.0])
    x = bounded_below.from_normal(z)
    np.testing.assert_allclose(stats.norm.logsf(x), stats.norm.logsf(z) + stats.norm.logsf(-1.0), rtol=1e-12)
    np.testing.assert_array_equal(bounded_above.from_normal(-z), -x)


@every_prior
def test_shapes_and_single_precision(prior: Prior):
    assert prior.from_normal(0).shape == ()
    assert prior.from_normal(np.zeros((2, 3))).shape == (2, 3)
    if "high" in prior.arguments and prior.arguments["high"] == -12:
        return  # single precision ends before such a tail
    with jax.enable_x64(False):
        z = jnp.linspace(-6, 6, 25)
        x = prior.from_normal(z, jnp)
        assert x.dtype == jnp.float32
        np.testing.assert_allclose(x, prior.from_normal(np.asarray(z, float)), rtol=2e-2, atol=1e-4)


def test_equal_priors_are_equal_and_hashable():
    one, same = (Prior.parse({"Normal": {"scale": 2}}, "here") for _ in range(2))
    assert one == same and len({one, same}) == 1
    assert one.arguments == {"loc": 0.0, "scale": 2.0}
    assert one != Prior.parse({"Normal": {"scale": 3}}, "here")


@pytest.mark.parametrize(
    ("spec", "found", "allowed"),
    [
        ({"Norml": {}}, "Norml", "did you mean 'Normal'? allowed: Normal, TruncatedNormal"),
        ({"Normal": {"scael": 1}}, "Normal.scael", "did you mean 'scale'? allowed: loc, scale"),
        ({"Normal": {"scale": 0}}, "Normal.scale: found 0", "above 0"),
        ({"Normal": {"scale": -1.5}}, "-1.5", "above 0"),
        ({"Normal": {"loc": math.inf}}, "inf", "finite number"),
        ({"Normal": {"loc": math.nan}}, "nan", "finite number"),
        ({"Normal": {"loc": "1"}}, "'1'", "finite number"),
        ({"Normal": {"loc": True}}, "True", "finite number"),
        ({"Normal": 3}, "3", "a table of loc, scale"),
        ({}, "0 families", "Normal = {"),
        ({"Normal": {}, "Beta": {}}, "2 families", "one"),
        ({"Uniform": {"low": 2, "high": 1}}, "low = 2, high = 1", "low below high"),
        ({"TruncatedNormal": {"low": 1, "high": 1}}, "low = 1", "low below high"),
        ({"TruncatedNormal": {"loc": 0, "scale": 1, "low": 50}}, "bounds 50 to inf", "bounds near loc"),
        ({"Gamma": {"rate": 1}}, "Gamma.concentration: missing", "concentration, rate"),
        ({"LogUniform": {"low": 0, "high": 1}}, "LogUniform.low", "above 0"),
        ({"Beta": {"concentration1": 1}}, "concentration0: missing", "concentration1, concentration0"),
    ],
)
def test_mistakes_are_named(spec, found: str, allowed: str):
    with pytest.raises(StudyError) as caught:
        Prior.parse(spec, "study.toml: psi.mass.prior")
    message = str(caught.value)
    assert "\n" not in message and message.startswith("study.toml: psi.mass.prior")
    assert found in message and allowed in message
