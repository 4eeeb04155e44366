"""Problems of vectors by the same methods as studies: posteriors in closed form, refusals, the commands."""

import json
from dataclasses import replace

import arviz as az
import numpy as np
import pytest
from typer.testing import CliRunner

from det2stoc_bayes import cli
from det2stoc_bayes.errors import Det2StocError, EngineError, MethodNotApplicable
from det2stoc_bayes.inference import METHODS, get_method
from det2stoc_bayes.inference._sampling import OF_VECTORS
from det2stoc_bayes.models import POSED, VECTORS, posed, trivariate
from det2stoc_bayes.posterior import ATTRIBUTES, GROUPS, load, save
from det2stoc_bayes.two_samples import gaussian_kl
from det2stoc_bayes.vector_density import find_peak

EXACT = ("blackjax_nuts", "emcee", "laplace", "nuts", "smc")  # laplace is exact of a Gaussian
MOST_KL = 0.03  # nat, of 3 unknowns and 1000 draws; measured: 0.002 to 0.008


@pytest.fixture(scope="module")
def problem():
    return posed("trivariate")


def test_the_closed_form_is_prior_times_likelihood(problem):
    """Of each s' by quadrature: the conditional that the thesis asks for, from its other side."""
    mean, covariance = trivariate.closed_form(problem)
    grid = np.linspace(-6, 6, 4001)
    for k in range(3):
        z = np.where(np.arange(3) == k, grid[:, None], mean)
        density = np.exp(problem.problem.log_density(z, problem.x) - problem.problem.log_density(mean[None], problem.x))
        density /= density.sum()
        assert density @ grid == pytest.approx(mean[k], abs=1e-9)
        assert density @ (grid - mean[k]) ** 2 == pytest.approx(covariance[k, k], rel=1e-9)


def test_pairs_are_drawn_from_the_likelihood(problem):
    """Mean and covariance of 20,000 pairs under one s', within 4 standard errors."""
    theta = problem.problem.constrained(np.full((20_000, 3), 0.7))
    x = problem.problem.simulate(theta, np.random.default_rng(0)).reshape(-1, 3, 2)
    gaussian = problem.problem.gaussian
    joint = gaussian.sample(np.random.default_rng(1), 400_000)
    joint = joint[np.abs(joint[:, 0] - theta[0, 0]) < 0.02]
    for k in range(3):
        error = np.sqrt(x[:, k].var(0) / len(x) + joint[:, 1:].var(0) / len(joint))
        assert (np.abs(x[:, k].mean(0) - joint[:, 1:].mean(0)) < 4 * error).all()
        np.testing.assert_allclose(np.cov(x[:, k].T), np.cov(joint[:, 1:].T), rtol=0.1)


def test_the_peak_is_the_closed_form_s(problem):
    mean, covariance = trivariate.closed_form(problem)
    density = find_peak(problem)
    np.testing.assert_allclose(density.center, mean, atol=1e-6)
    np.testing.assert_allclose(density.scale @ density.scale.T, covariance, atol=1e-6)
    terms, gradient = density.terms_and_grad(density.center[None] + 0.1)
    np.testing.assert_allclose(terms.sum(), density.log_likelihood(density.center[None] + 0.1)[0])
    wanted = (density.center + 0.1) - np.linalg.solve(covariance, np.full(3, 0.1))  # of the likelihood alone
    np.testing.assert_allclose(gradient[0], wanted, rtol=1e-5)


@pytest.mark.parametrize("name", EXACT)
def test_draws_are_those_of_the_closed_form(name, problem, tmp_path):
    tree = get_method(name).fit(problem, 3, num_samples=1000)
    mean, covariance = trivariate.closed_form(problem)
    z = tree["unconstrained_posterior"]["z"].values.reshape(-1, 3)
    assert gaussian_kl(z, mean, covariance) < MOST_KL
    assert set(GROUPS) <= set(tree.children) and set(ATTRIBUTES) <= set(tree.attrs)
    assert tuple(tree.posterior) == problem.names
    ess = min(float(v) for v in az.ess(tree.posterior).values())
    sd = np.sqrt(np.diag(covariance))
    assert (np.abs(z.mean(0) - mean) < 4 * sd / np.sqrt(ess)).all() and ess > 300
    gaussian, given = problem.problem.gaussian, problem.x.reshape(-1, 2)
    after = np.stack([tree.posterior[n].values.mean() for n in problem.names])
    assert (np.abs(after - gaussian.conditional(given)[0]) < 4 * np.sqrt(gaussian.conditional(given)[1] / ess)).all()
    np.testing.assert_allclose(
        tree.log_likelihood["values"].values.reshape(-1, 3),
        problem.problem.by_recording(problem.problem.constrained(z), problem.x),
    )
    save(tree, tmp_path / "fit.nc")
    assert load(tmp_path / "fit.nc").equals(tree)


@pytest.mark.parametrize("refine", ["none", "psis"])
def test_npe_learns_the_conditional(refine, problem):
    options = {"num_simulations": 2000, "num_members": 1, "num_epochs": 60, "refine": refine}
    tree = get_method("npe").fit(problem, 1, num_samples=1000, **options)
    mean, covariance = trivariate.closed_form(problem)
    z = tree["unconstrained_posterior"]["z"].values.reshape(-1, 3)
    assert gaussian_kl(z, mean, covariance) < (0.2 if refine == "none" else MOST_KL)
    assert tree.attrs["simulations"] == 2000


@pytest.mark.parametrize("name", sorted(set(METHODS) - set(OF_VECTORS)))
def test_methods_that_need_a_study_say_which_do_not(name, problem):
    with pytest.raises(MethodNotApplicable, match=f"{name}: trivariate has no .*; allowed: blackjax_nuts, emcee, lap"):
        get_method(name).fit(problem, 0)


def test_what_has_no_observation_or_engine_is_refused():
    assert set(POSED) < set(VECTORS)
    with pytest.raises(Det2StocError, match="slcp: has no observation of its own; allowed: trivariate"):
        posed("slcp")
    with pytest.raises(EngineError, match="engine: found mjx; allowed: c"):
        posed("trivariate", "mjx")


def test_another_observation_is_another_problem(problem):
    other = replace(problem, x=problem.x + 1e-9)
    assert other.fingerprint != problem.fingerprint == posed("trivariate").fingerprint


def test_the_commands_run_such_a_problem(tmp_path):
    def run(*line):
        shown = CliRunner().invoke(cli.app, [*line, "--jobs", "1", "--json"])
        assert shown.exit_code == 0, shown.stderr
        return json.loads(shown.stdout)

    out = tmp_path / "compared"
    methods = ("emcee", "laplace+psis", "prior", "det2stoc")
    told = run("compare", "trivariate", "--methods", ",".join(methods), "--out", str(out))
    verdicts = {row["label"]: row["verdict"] for row in told["rows"]}
    assert verdicts == {"emcee": "trust", "laplace+psis": "trust", "prior": "do not trust"}
    assert told["reference"]["label"] == "the closed form" and set(told["failed"]) == {"det2stoc"}
    assert all(row["kl"] is not None for row in told["rows"])
    before = {p.name: p.stat().st_mtime_ns for p in (out / "runs").iterdir()}
    run("compare", "trivariate", "--methods", "emcee,prior", "--out", str(out))
    assert before == {p.name: p.stat().st_mtime_ns for p in (out / "runs").iterdir()}
    line = ("calibrate", "trivariate", "--method", "laplace", "--num-replications", "60")
    told = run(*line, "--out", str(tmp_path / "calibrated"))
    assert told["calibrated"] and not told["failed"] and len(told["unknowns"]) == 3
