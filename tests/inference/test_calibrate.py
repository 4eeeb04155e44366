"""The command calibrate, and a method that learns once for all replications."""

import json
import pickle
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from det2stoc_bayes import cli, verbs_calibrate
from det2stoc_bayes.errors import MethodNotApplicable
from det2stoc_bayes.inference import _surrogate, _vectors, det2stoc, get_method
from det2stoc_bayes.inference._flow import Training
from det2stoc_bayes.models import get_problem, linear_gaussian
from det2stoc_bayes.replication import bare, fitted_start, replicate

SMALL = {"num_simulated": 200, "num_steps": 60}


@pytest.fixture(scope="module")
def replications():
    """Two replications of the linear Gaussian study."""
    problem = bare(get_problem("linear_gaussian", num_threads=1))
    start = fitted_start(problem)
    return [replicate(problem, start, np.random.default_rng([7, i]))[0] for i in range(2)]


def test_a_replications_posterior_is_the_closed_form(replications):
    for problem in replications:
        z = (
            get_method("laplace")
            .fit(problem, 1, num_samples=4000)["unconstrained_posterior"]["z"]
            .values.reshape(-1, 2)
        )
        mean, covariance = linear_gaussian.exact_posterior(problem)
        setting = linear_gaussian.SETTING
        sd = np.sqrt(np.diag(covariance)) / setting.prior_sd
        np.testing.assert_allclose(z.mean(0), (mean - setting.prior_mean) / setting.prior_sd, atol=5 * sd.max() / 63)
        np.testing.assert_allclose(z.std(0), sd, rtol=5 / np.sqrt(2 * 4000))


def test_the_command_writes_report_and_numbers_and_goes_on(gaussian_study, tmp_path):
    out = tmp_path / "out"

    def calibrated(count, *more):
        line = ["calibrate", str(gaussian_study), "--method", "laplace", "--num-replications", str(count)]
        shown = CliRunner().invoke(cli.app, [*line, "--out", str(out), "--jobs", "1", *more])
        assert shown.exit_code == 0, shown.stderr
        return shown.stdout

    told = json.loads(calibrated(20, "--json"))
    assert told == json.loads((out / "calibration.json").read_text())
    assert (told["problem"], told["method"], told["num_replications"]) == ("slides", "laplace", 20)
    assert [u["name"] for u in told["unknowns"]] == ["gravity_x", "gravity_z"] and not told["trained_once"]
    before = (out / "replications.jsonl").read_text()
    shown = calibrated(22)
    assert (out / "replications.jsonl").read_text().startswith(before)
    assert len((out / "replications.jsonl").read_text().splitlines()) == 22
    assert "laplace on slides is calibrated" in shown and "all together (TARP)" in shown
    assert "22 replications" in (out / "report.html").read_text()


def test_det2stoc_learns_once_and_weighs_any_recordings(replications, monkeypatch):
    learned = []

    def draws(surrogate, key, num_chains, num_draws):
        """Draws of the prior in the place of NUTS, which test_det2stoc runs: the densities are what is asked for."""
        z = np.random.default_rng(0).standard_normal((num_chains, num_draws, 2))
        learned.append(np.asarray(jax.vmap(jax.vmap(lambda one: surrogate.terms(one).sum()))(jnp.asarray(z)), float))
        return z, {"potential_energy": 0.5 * (z**2).sum(-1) - learned[-1], "diverging": np.zeros(z.shape[:2], bool)}

    monkeypatch.setattr(_surrogate.Surrogate, "draws", draws)
    trained = pickle.loads(pickle.dumps(det2stoc.train(replications[0], 3, **SMALL)))
    one, other = (det2stoc.apply(trained, p, 5, num_samples=40) for p in replications)
    assert json.loads(one.attrs["options"]) == {"num_samples": 40, "num_iterations": 1, "refine": "none"} | SMALL
    for tree, density in zip((one, other), learned, strict=True):
        exact = tree["log_likelihood"]["values"].sum("recording").values
        weight = tree["sample_stats"]["log_weight"].values
        np.testing.assert_allclose(np.diff(weight.ravel()), np.diff((exact - density).ravel()), rtol=1e-4, atol=1e-3)
    assert np.ptp(learned[0] - learned[1]) > 1  # nats: they are told apart


def test_a_method_that_learns_once_does_so_for_all_replications(monkeypatch, tmp_path):
    counted = []
    laplace = get_method("laplace").fit

    def train(problem, key):
        counted.append(key)
        return "learned"

    def apply(trained, problem, key, *, num_samples, refine="none"):
        assert trained == "learned"
        return laplace(problem, key, num_samples=num_samples, refine=refine)

    monkeypatch.setattr(det2stoc, "train", train)
    monkeypatch.setattr(det2stoc, "apply", apply)
    options = {"num_replications": 2, "jobs": 1, "seed": 9}
    found = verbs_calibrate.calibrate("linear_gaussian", "det2stoc", tmp_path, **options)
    assert found.trained_once and counted == [9]
    assert verbs_calibrate.calibrate("linear_gaussian", "det2stoc", tmp_path, **options).verdict == found.verdict
    assert counted == [9]  # nothing was left to do


def test_a_problem_of_vectors_is_calibrated_by_npe_alone(monkeypatch, tmp_path):
    few = Training(num_members=1, num_layers=2, width=16, depth=1, num_epochs=40)
    monkeypatch.setattr(_vectors, "train", partial(_vectors.train, num_simulations=500, training=few))
    options = {"num_replications": 20, "jobs": 1, "seed": 2}
    found = verbs_calibrate.calibrate("two_moons", "npe", tmp_path, **options)
    assert [u.name for u in found.unknowns] == ["theta_1", "theta_2"] and found.trained_once and not found.failed
    assert found.ranks.shape == (20, 2) and all(0.005 < u.sd < 0.9 for u in found.unknowns)  # far from the prior's
    with pytest.raises(
        MethodNotApplicable, match="--method: two_moons is a problem of vectors; found nuts; allowed: n"
    ):
        verbs_calibrate.calibrate("two_moons", "nuts", tmp_path, **options)
