"""The analytic check: its divergence against a closed form, its results, its page."""

import json

import equinox as eqx
import numpy as np
import pytest
from typer.testing import CliRunner

from det2stoc_bayes import cli
from det2stoc_bayes.inference._cvae import Cvae, standard_normal
from det2stoc_bayes.models.trivariate import Trivariate, draw
from det2stoc_bayes.reproduce import trivariate
from det2stoc_bayes.transitions import Scaling

TINY = trivariate.Settings(num_gaussians=1, num_steps=500, num_samples=20_000)


class Fixed(eqx.Module):
    """The same Gaussian whatever is given."""

    def __call__(self, x, z):
        return 0.3 + 0.5 * z, np.ones(1)


def test_the_conditional_is_that_of_a_regression():
    truth = draw(np.random.default_rng(4))
    draws = truth.sample(np.random.default_rng(5), 400_000)
    mean, variance = truth.conditional(draws[:, 1:])
    assert abs((draws[:, 0] - mean).mean()) < 4 * np.sqrt(variance / len(draws))
    assert np.var(draws[:, 0] - mean) == pytest.approx(variance, rel=0.01)
    assert np.abs(np.corrcoef((draws[:, 0] - mean), draws[:, 1])[0, 1]) < 0.01


def test_the_divergence_is_the_closed_form():
    truth = Trivariate(np.zeros(3), np.diag([0.49, 1.0, 1.0]))
    scaling = Scaling(np.zeros(2), np.ones(2), np.zeros((3, 1)), np.array([2.0]))
    cvae = Cvae(Fixed(), Fixed(), standard_normal(1), False)
    trained = trivariate.Trained(truth, scaling, cvae, {})
    # z integrated out: N(0.6, 4 * 1.25).
    variance = 4 * 1.25
    expected = 0.5 * (0.49 / variance + 0.36 / variance - 1 + np.log(variance / 0.49))
    found = trained.divergences(cvae, np.zeros((2, 2)))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp("trivariate")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trivariate.Settings, "quick", lambda: TINY)
        answer = CliRunner().invoke(cli.app, ["reproduce", "trivariate", "--quick", "--out", str(out), "--seed", "3"])
    assert answer.exit_code == 0, answer.output
    return out


def test_it_learns_the_conditional(done):
    result = json.loads((done / "results.json").read_text())
    assert result["divergence"]["mean"] < 0.01  # measured: 0.004
    assert result["divergence"]["worst"] < 0.15  # measured: 0.063; eight times the steps are for less than 0.05
    (case,) = result["cases"]
    assert set(case["densities"]) == {"0", "100", "500"}
    assert case["divergence_by_step"]["0"] > 20 * case["divergence_by_step"]["500"]
    area = np.trapezoid(case["densities"]["500"], case["grid"])
    assert area == pytest.approx(np.ones(3), abs=0.02)


def test_its_page_stands_alone(done):
    page = (done / "report.html").read_text()
    assert page.count('data-source="density-') == 3
    assert "http" not in page.split("<script>")[0].replace("http-equiv", "")


def test_what_is_done_is_not_done_again(done, monkeypatch):
    monkeypatch.setattr(trivariate.Settings, "quick", lambda: TINY)
    monkeypatch.setattr(trivariate, "examine", lambda *_: pytest.fail("trained again"))
    again = trivariate.run(done, seed=3, quick=True)
    assert again == json.loads((done / "results.json").read_text())
    with pytest.raises(pytest.fail.Exception):
        trivariate.run(done, seed=4, quick=True)


def test_unknown_experiments_are_refused(tmp_path):
    answer = CliRunner().invoke(cli.app, ["reproduce", "trivariat", "--out", str(tmp_path / "x")])
    assert answer.exit_code == 2
    assert "trivariate" in answer.stderr
    assert not (tmp_path / "x").exists()
