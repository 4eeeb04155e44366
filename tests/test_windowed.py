"""Windows of recordings that begin alike: the likelihood made of simulations, its coordinates, and Windy Slope's."""

from typing import ClassVar

import mujoco
import numpy as np
import pytest

from det2stoc_bayes.inference import get_method
from det2stoc_bayes.models import windy_slope, windy_slope_mjx
from det2stoc_bayes.models._population import Normals
from det2stoc_bayes.models._response import Response
from det2stoc_bayes.models._windowed import Windowed
from det2stoc_bayes.priors import Prior
from det2stoc_bayes.report.summary import summarize
from det2stoc_bayes.study import Parameter, Target
from det2stoc_bayes.two_samples import c2st
from det2stoc_bayes.vector_density import VectorDensity, find_peak
from det2stoc_bayes.vector_problem import Posed

LOW, HIGH = np.array([-1.0, 0.0]), np.array([1.0, 4.0])


def seen(psi):
    """Smooth in psi, with a scatter that follows from its last digits: chaos, of sd 0.02 and 0.06."""
    first, second = psi.T
    smooth = np.stack([first + 0.1 * second**2, first * second, np.sin(first)], 1)
    digits = 2 * np.modf(np.abs(1e7 * psi))[0] - 1
    return smooth + np.sqrt(3) * np.stack([0.02 * digits[:, 0], 0.06 * digits[:, 1], 0 * first], 1)


def _parameter(name, bounds):
    prior = Prior("TruncatedNormal", dict(zip(("loc", "scale", "low", "high"), bounds, strict=True)))
    return Parameter(name, Target("opt", "", name), None, prior, "trajectory")


class Toy(Windowed):
    """Three recordings of two psi."""

    name: ClassVar = "toy"
    parameters: ClassVar = (_parameter("a", (0.1, 0.5, -1.0, 1.0)), _parameter("b", (2.0, 1.0, 0.0, 4.0)))
    reality: ClassVar = Normals((0.3, 1.5), (0.2, 0.3))
    noise: ClassVar = np.array([0.03, 0.03, 0.03])
    recordings = ("one", "two", "three")
    num_simulated = 1000

    def seen(self, psi):
        return seen(psi)


@pytest.fixture(scope="module")
def posed():
    toy = Toy()
    return Posed(toy, toy.observed)


def test_a_response_is_the_density_of_new_simulations():
    """Of 3000 new ones: squares of white errors are those of unit normals, and densities are the Gaussian's."""
    random = np.random.default_rng(0)
    psi, new = (LOW + (HIGH - LOW) * random.uniform(size=(n, 2)) for n in (2000, 3000))
    noise = np.array([0.03, 0.03, 0.03])
    found = Response.of(psi, seen(psi), noise, (LOW, HIGH))
    x = seen(new) + noise * random.standard_normal((3000, 3))
    there = found.components(x)
    error = there - found.predicted(new)
    assert there.shape[1] == 3
    np.testing.assert_allclose(np.cov(error.T), np.eye(3), atol=0.12)  # 4 standard errors of 0.026
    assert np.abs(error.mean(0)).max() < 0.08
    sd = np.sqrt(np.array([0.02, 0.06, 0.0]) ** 2 + noise**2)
    mean = np.stack([new[:, 0] + 0.1 * new[:, 1] ** 2, new[:, 0] * new[:, 1], np.sin(new[:, 0])], 1)
    white, variance = (x - mean) / noise, (sd / noise) ** 2
    exact = -0.5 * (white**2 / variance + np.log(2 * np.pi * variance)).sum(1)
    assert np.abs(found.log_density(new, there) - exact).mean() < 0.15  # nat; measured: 0.06


def test_the_density_is_the_same_in_both_coordinates(posed):
    """log p(w) - log p(z) is the log of |dz/dw|, by finite differences."""
    toy = posed.problem
    density = find_peak(posed)
    natural = VectorDensity(posed, np.zeros(posed.size), np.eye(posed.size), natural=True)
    random = np.random.default_rng(1)
    for w in density.center + random.standard_normal((4, posed.size)) @ density.scale.T:
        step = 1e-5 * np.eye(posed.size)
        jacobian = (toy.outward(w + step) - toy.outward(w - step)) / 2e-5
        change = density.log_density(w[None]) - natural.log_density(toy.outward(w[None]))
        assert change[0] == pytest.approx(np.linalg.slogdet(jacobian)[1], abs=1e-4)
        np.testing.assert_allclose(toy.constrained(toy.outward(w[None])), toy.placed(w[None]), rtol=1e-9)


def test_names_are_in_the_order_of_the_unknowns(posed):
    z = np.random.default_rng(2).standard_normal((5, posed.size))
    theta = dict(zip(posed.names, posed.problem.constrained(z).T, strict=True))
    assert posed.names[:3] == ("a_mu", "a_sigma", "a[one]") and posed.size == 10
    np.testing.assert_array_equal(theta["a_mu"], posed.problem.parameters[0].prior.from_normal(z[:, 0]))
    assert (theta["b_sigma"] > 0).all() and ((theta["b[two]"] > 0) & (theta["b[two]"] < 4)).all()


def test_gradients_are_those_of_the_density(posed):
    density = find_peak(posed)
    w = density.center + 0.5 * np.random.default_rng(3).standard_normal(posed.size) @ density.scale.T
    terms, gradient = density.terms_and_grad(w[None])
    step = 1e-6 * np.eye(posed.size)
    wanted = (density.log_likelihood(w + step) - density.log_likelihood(w - step)) / 2e-6
    np.testing.assert_allclose(gradient[0], wanted, rtol=1e-2, atol=1e-2 * np.abs(wanted).max())
    assert terms.sum() == pytest.approx(density.log_likelihood(w[None])[0])


@pytest.mark.long
def test_exact_samplers_agree_and_find_the_population(posed):
    draws = {}
    for name in ("emcee", "smc"):
        tree = get_method(name).fit(posed, 4, num_samples=600)
        draws[name] = tree["unconstrained_posterior"]["z"].values.reshape(-1, posed.size)
        posterior = tree.posterior.to_dataset()
        assert posterior["a"].dims == ("chain", "draw", "recording")
        for k, psi in enumerate(("a", "b")):
            own = posterior[psi].values.reshape(-1, 3)
            off = (own.mean(0) - posed.problem.truth[:, k]) / own.std(0)
            assert np.abs(off).max() < 4
            assert tree.log_likelihood["values"].shape[-1] == 3
        exact = posed.problem.by_recording(posed.problem.constrained(draws[name]), posed.x)
        np.testing.assert_allclose(tree.log_likelihood["values"].values.reshape(-1, 3), exact, atol=1e-6)
        rows = {row.name: row for row in summarize(tree)}
        assert (rows["a[one]"].r_hat is None) == (name == "emcee")  # walkers are no independent chains
    assert c2st(draws["smc"], draws["emcee"]) < 0.55


class Short(windy_slope.WindySlope):
    """With fewer simulations."""

    num_simulated = 4096


@pytest.fixture(scope="module")
def slope():
    short = Short()
    return Posed(short, short.observed)


def test_windy_slope_s_likelihood_holds_of_new_recordings(slope):
    """Of 200 new windows of reality: mean and spread of the sum of squares, and what the components' errors are."""
    problem, random = slope.problem, np.random.default_rng(5)
    psi = windy_slope.REALITY.draw(random, 200)
    x = problem.seen(psi)
    x = x + problem.noise * random.standard_normal(x.shape)
    error = problem.response.components(x) - problem.response.predicted(psi)
    squares = (error**2).mean(1)
    assert error.shape[1] > 10 and 0.85 < squares.mean() < 1.15  # measured, of 8192 simulations: 1.0
    assert np.abs(error.mean(0)).max() < 0.4  # measured, of 8192 simulations: 0.16


def test_windy_slope_s_peak_is_near_the_truth(slope):
    density = find_peak(slope)
    own = slope.problem.placed(density.center[None])
    random = np.random.default_rng(6)
    spread = slope.problem.placed(density.center + random.standard_normal((400, slope.size)) @ density.scale.T).std(0)
    for b, truth in zip(slope.unknowns.blocks, slope.problem.truth.T, strict=True):
        rows = slice(b.first_own, b.stop)
        assert (np.abs(own[0, rows] - truth) < 5 * spread[rows]).all()
        assert (spread[rows] < 0.6 * windy_slope.REALITY.scale[slope.unknowns.blocks.index(b)]).all()


def test_windows_turn_as_the_recorded_angles_do():
    """Noise of a quaternion's numbers of s is noise of 2 s in the rotation vector."""
    random, s = np.random.default_rng(7), 5e-4
    states = windy_slope.simulate(np.array([[0.23, 0.11, -1.7]]), num_steps=20)
    full = windy_slope.full_state(states[0])
    noisy = full[None] + s * np.r_[np.zeros(3), np.ones(4), np.zeros(6)] * random.standard_normal((500, *full.shape))
    noisy[:, 0] = full[0]
    out = np.empty((500, 21, 18))
    windy_slope.write_state(noisy.reshape(-1, 13)[:, :7], noisy.reshape(-1, 13)[:, 7:], out.reshape(-1, 18))
    turn = windy_slope.windows(out).reshape(500, 5, 12)[..., 3:6]
    np.testing.assert_allclose(turn.std(0), 2 * s, rtol=0.15)


@pytest.mark.long
def test_mjx_and_c_see_the_same_window(monkeypatch):
    """The prism and the pyramidal cone in both engines."""
    import jax

    model = windy_slope_mjx.prism_model()
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    monkeypatch.setattr(windy_slope, "load_model", lambda: model)
    monkeypatch.setattr(windy_slope_mjx, "prism_model", lambda sides=16: model)
    psi = np.array([[0.23, 0.11, -1.7], [0.22, 0.15, -1.65]])
    with jax.enable_x64(True):
        found = windy_slope.windows(windy_slope_mjx.simulate(psi, num_steps=20))
    np.testing.assert_allclose(found, windy_slope.windows(windy_slope.simulate(psi, num_steps=20)), atol=1e-4)
