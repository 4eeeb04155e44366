"""psi that varies by recording: populations against their closed form and against truth."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from scipy.optimize import minimize_scalar
from simulated import SPRING, add_holdout, fit, noise_table, pose, recordings

from det2stoc_bayes.density import Density
from det2stoc_bayes.inference import get_method
from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.heldout import evaluate
from det2stoc_bayes.optimize import fit_many
from det2stoc_bayes.populations import freed, log_spread_sd
from det2stoc_bayes.study import load_study

PSI = """
[psi.stiffness]
target = "joint/slide/stiffness"
prior = { Normal = { loc = 30, scale = 4 } }
varies = "trajectory"
[psi.damping]
target = "joint/slide/damping"
prior = { Normal = { loc = 0.4, scale = 0.1 } }
"""
PRIOR_SD, COUNT = 4.0, 12


def springs(folder, toml=PSI, count=COUNT, sd=1.5, noise=1e-3, seed=3, holdout=2):
    """Springs of different stiffness; the last ones are held out."""
    xml, rng = model_xml(SPRING), np.random.default_rng(seed)
    truth, made = 31.0 + sd * rng.standard_normal(count + holdout), {}
    for k, stiffness in enumerate(truth):

        def change(model, stiffness=stiffness):
            model.jnt_stiffness[0] = stiffness

        start = ([rng.uniform(-0.4, 0.4)], [rng.uniform(-1.5, 1.5)])
        one = recordings(xml, [start], 10 * np.arange(40), (noise, 10 * noise), seed=seed + k, change=change)
        made[f"run_{k:02d}"] = one["run_0"]
    first = dict(list(made.items())[:count])
    toml = ('holdout = "holdout/*.csv"\n' if holdout else "") + toml + noise_table(noise, 10 * noise)
    study = make_study(folder, xml, toml, first)
    if holdout:
        add_holdout(study, dict(list(made.items())[count:]))
    return pose(load_study(study.folder)), truth


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    problem, truth = springs(tmp_path_factory.mktemp("springs") / "study")
    return fit(problem, tolerance=1e-4), truth


def test_the_population_is_that_of_the_closed_form(fitted):
    """Stiffnesses are known to 0.3 %: sigma's marginal posterior follows from their scatter alone."""
    found, truth = fitted
    values = found.problem.psi_by_segment(found.point.z)[:, 0]
    np.testing.assert_allclose(values, truth[:COUNT], atol=0.3)  # measured: 0.12

    def minus(log_sigma):
        sigma, d = np.exp(log_sigma), values - np.mean(values)
        wide = sigma**2 + 0.0  # mu integrated out under its prior, N(30, 4)
        count, mean = len(values), np.mean(values)
        total = wide / count + PRIOR_SD**2
        like = -0.5 * (count - 1) * np.log(wide) - 0.5 * (d @ d) / wide
        like += -0.5 * np.log(total) - 0.5 * (mean - 30) ** 2 / total
        return -(like + log_sigma - 0.5 * (sigma / (PRIOR_SD / 2)) ** 2)

    closed = float(np.exp(minimize_scalar(minus, bounds=(-3, 3), method="bounded").x))
    assert found.problem.spreads is not None
    assert found.problem.spreads[0] == pytest.approx(closed, rel=0.01)  # measured: 0.02 %
    assert float(found.problem.psi(found.point.z)[0]) == pytest.approx(np.mean(values), abs=0.1)  # measured: 0.024
    # A dozen values tell a spread to 1 / sqrt(2 * 12) = 0.204; measured: 0.198.
    assert log_spread_sd(found)[0] == pytest.approx(1 / np.sqrt(2 * COUNT), rel=0.1)


def test_values_that_are_known_well_do_not_hold_mu_where_it_is(tmp_path):
    """A mu off its values, which stay: one fit leads back, although the values are known to 1e-5 of their spread."""
    found = fit(springs(tmp_path / "study", noise=1e-6, holdout=0)[0], tolerance=1e-4)
    problem, away = found.problem, found.point.z.copy()
    block = problem.unknowns.varying[0]
    away[block.begin] += 1.0
    away[block.first_own : block.stop] -= block.shared_slopes(away)[0]
    np.testing.assert_allclose(block.values(away), block.values(found.point.z), rtol=1e-9)
    for z in (found.point.z, away):
        again = fit_many([(problem, Point(z, found.point.start))], tolerance=1e-4)[0]
        assert again is not None
        own, slope = again.point.z[block.first_own : block.stop], block.shared_slopes(again.point.z)[0]
        print(again.end, again.point.z[block.begin], own @ slope)
        assert again.point.z[block.begin] == pytest.approx(own @ slope, abs=0.02)  # where the prior has it


def test_a_new_recording_gets_its_own_value(fitted):
    """Held-out recordings are drawn from the population, not held at its mean."""
    found, _ = fitted
    study = found.problem.simulator.study
    own = evaluate(found, dict.fromkeys((r.name for r in study.holdout), found.point.z), study.holdout, None)
    assert (own.chi2 / own.num_values < 1.5).all()  # measured: 0.95 to 0.99
    alone = fit(replace_varies(found.problem), tolerance=1e-3)
    same = evaluate(alone, dict.fromkeys((r.name for r in study.holdout), alone.point.z), study.holdout, None)
    # Measured: 719 against 151 for 154 values, and 277 nats.
    assert same.chi2.sum() > 3 * own.chi2.sum()
    assert own.log_density.sum() > same.log_density.sum() + 100


def replace_varies(problem):
    """The same problem with one value for all recordings."""
    simulator = problem.simulator
    study = replace(simulator.study, parameters=tuple(replace(p, varies="never") for p in simulator.parameters))
    return pose(study)


def test_equal_recordings_leave_no_spread(tmp_path):
    problem, _ = springs(tmp_path / "study", sd=0.0, holdout=0)
    found = fit(problem, tolerance=1e-3)
    assert found.problem.spreads is not None
    assert found.problem.spreads[0] < 0.15  # measured: 0.04; one recording tells its stiffness to 0.1


def test_bounds_of_the_prior_hold_for_every_recording(tmp_path):
    toml = PSI.replace("Normal = { loc = 30, scale = 4 }", "TruncatedNormal = { loc = 30, scale = 4, low = 30.5 }")
    problem, _ = springs(tmp_path / "study", toml=toml, holdout=0)
    z = np.random.default_rng(0).normal(size=(200, problem.size)) * 3
    values = problem.psi_by_segment(z)[..., 0]
    assert values.min() >= 30.5 and np.isfinite(values).all() and values.std() > 0.1


def test_the_joint_density_is_the_one_declared(fitted):
    """exp(log density) of mu, sigma and the recordings' values against prior and likelihood written out by hand."""
    found, _ = fitted
    free = freed(found)
    density, problem = Density.at(free), free.problem
    assert problem.names[:3] == ("stiffness_mu", "stiffness_sigma", "stiffness[run_00]")
    z = free.point.z + 0.01 * np.random.default_rng(1).normal(size=(3, problem.size))
    values = problem.constrained(z)
    sigma = values["stiffness_sigma"]
    assert (np.diff(sigma[np.argsort(z[:, 1])]) > 0).all()
    for k in range(COUNT):
        expected = values["stiffness_mu"] + sigma * z[:, 2 + k]
        np.testing.assert_allclose(values[f"stiffness[run_{k:02d}]"], expected, rtol=1e-9)
    moved = z.copy()
    moved[:, 2] += 0.5  # the first recording's own value
    change = density.log_likelihood_by_recording(moved) - density.log_likelihood_by_recording(z)
    assert (change[:, 0] != 0).all() and (change[:, 1:] == 0).all()


def test_gradients_are_those_of_the_density(fitted):
    """One move of all recordings' own values gives the derivative in each of them."""
    free = freed(fitted[0])
    density = Density.at(free)
    z = free.point.z + 0.3 * density.scale @ np.random.default_rng(2).normal(size=free.problem.size)
    _, gradient = density.value_and_grad(z[None])
    for i in (0, 1, 2, 7, free.problem.size - 1):
        h = 1e-2 * np.sqrt((density.scale[i] ** 2).sum()) * np.eye(len(z))[i]
        above, below = density.log_density(np.stack([z + h, z - h]))
        expected = (above - below) / (2 * h[i])
        assert gradient[0, i] * h[i] == pytest.approx(expected * h[i], rel=0.02, abs=2e-4)


@pytest.mark.parametrize("method", ["laplace"])
def test_methods_sample_the_population(tmp_path, method):
    problem, truth = springs(tmp_path / "study", count=6, holdout=0, noise=5e-3)
    tree = get_method(method).fit(problem, 0, num_samples=200)
    posterior = tree["posterior"]
    assert posterior["stiffness"].dims == ("chain", "draw", "recording")
    mu, sigma = posterior["stiffness_mu"], posterior["stiffness_sigma"]
    error = abs(float(mu.mean()) - truth.mean()) / float(mu.std())
    assert error < 3 and 0.2 < float(mu.std()) < 1.5  # sd of the mean of six: 0.6
    assert float(sigma.quantile(0.01)) < truth.std() < float(sigma.quantile(0.99))
