"""A posterior as a domain-randomization set: whose draws, and models that say them."""

import csv
import json

import mujoco
import numpy as np
import pytest
import xarray as xr
from conftest import HINGE, make_study, model_xml
from typer.testing import CliRunner

from det2stoc_bayes import cli, posterior
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.randomization import draw_psi, export

TOML = """
[psi.mass]
target = "body/arm/mass"
prior = { Normal = { loc = 0.7, scale = 0.05 } }
[psi.loss]
target = "joint/hinge/damping"
prior = { TruncatedNormal = { loc = 0.05, scale = 0.02, low = 0.0 } }
varies = "trajectory"
[noise]
"qpos/hinge" = 1e-3
"""


@pytest.fixture
def study(tmp_path):
    return make_study(tmp_path / "study", model_xml(HINGE), TOML)


def tree_of(mu, sigma, mass):
    lead = ("chain", "draw")
    values = {"mass": mass, "loss_mu": mu, "loss_sigma": sigma}
    data = {name: (lead, np.reshape(v, (2, -1))) for name, v in values.items()}
    data["loss"] = ((*lead, "recording"), np.reshape(mu, (2, -1, 1)))
    return xr.DataTree.from_dict({"posterior": xr.Dataset(data)})


def test_draws_are_of_the_posterior_and_of_its_population(study):
    random = np.random.default_rng(0)
    mass, mu = random.normal(0.7, 0.01, 4000), random.normal(0.05, 0.002, 4000)
    tree = tree_of(mu, np.full(4000, 0.01), mass)
    psi = draw_psi(study, tree, 3000, np.random.default_rng(1))
    assert set(psi[:, 0]) <= set(mass) and len(set(psi[:, 0])) == 3000
    # A new episode has the spread of the population and what is not known of its mean.
    assert psi[:, 1].mean() == pytest.approx(0.05, abs=4 * 0.0102 / np.sqrt(3000))
    assert psi[:, 1].std() == pytest.approx(np.hypot(0.01, 0.002), rel=0.05)
    wide = draw_psi(study, tree_of(mu, np.full(4000, 0.1), mass), 500, np.random.default_rng(2))
    assert (wide[:, 1] > 0).all()


def test_models_say_what_the_table_says(study, tmp_path):
    tree = tree_of(np.full(20, 0.05), np.full(20, 0.01), np.linspace(0.6, 0.8, 20))
    written = export(study, tree, tmp_path / "out", num_draws=12, seed=3)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(p.name for p in written)
    rows = list(csv.DictReader((tmp_path / "out" / "psi.csv").open()))
    assert len(rows) == 12 and rows[0]["model"] == "model_01.xml"
    for row in rows:
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / row["model"]))
        assert model.body("arm").mass[0] == pytest.approx(float(row["mass"]), rel=1e-9)
        assert model.joint("hinge").damping[0] == pytest.approx(float(row["loss"]), rel=1e-9)
    (tmp_path / "out" / "model_arm.xml").write_text("another's")
    fewer = export(study, tree, tmp_path / "out", num_draws=3, seed=3)  # takes away what the last one wrote
    left = {p.name for p in (tmp_path / "out").iterdir()}
    assert left == {p.name for p in fewer} | {"model_arm.xml"}
    again = export(study, tree, tmp_path / "again", num_draws=12, seed=3, models=False)
    assert [p.name for p in again] == ["psi.csv"]
    alone = list(csv.DictReader(again[0].open()))
    assert alone == [{k: v for k, v in row.items() if k != "model"} for row in rows]


def test_a_posterior_of_another_study_is_refused(study):
    tree = xr.DataTree.from_dict({"posterior": xr.Dataset({"length": (("chain", "draw"), np.ones((1, 5)))})})
    with pytest.raises(Det2StocError, match="no psi 'mass'.*length"):
        draw_psi(study, tree, 3, np.random.default_rng(0))


def test_a_fit_that_infers_no_psi_is_refused(study):
    tree = xr.DataTree.from_dict({"predictions": xr.Dataset()})
    tree.attrs["method"] = "baseline_cvae"
    with pytest.raises(Det2StocError, match="baseline_cvae infers no psi"):
        draw_psi(study, tree, 3, np.random.default_rng(0))


def test_no_draw_and_a_file_in_the_place_of_the_folder_are_errors(study, tmp_path):
    tree = tree_of([0.1, 0.2], [0.1, 0.1], [1.0, 1.1])
    with pytest.raises(Det2StocError, match="num_draws: found -1; allowed: 1 or more"):
        export(study, tree, tmp_path / "out", num_draws=-1)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(Det2StocError, match="is a file; allowed: a folder"):
        export(study, tree, tmp_path / "file", num_draws=1)
    assert (tmp_path / "file").read_text() == "mine" and not (tmp_path / "out").exists()


def test_what_mjcf_does_not_take_is_an_error(tmp_path):
    """Moments of inertia of which one exceeds the sum of the others; the table alone says them."""
    toml = '[psi.inertia]\ntarget = "body/arm/inertia"\nindex = [0]\nprior = { Uniform = { low = 1, high = 2 } }\n'
    study = make_study(tmp_path / "study", model_xml(HINGE), toml)
    tree = xr.DataTree.from_dict({"posterior": xr.Dataset({"inertia": (("chain", "draw"), np.full((1, 4), 1.5))})})
    with pytest.raises(Det2StocError, match="draw 1, inertia = 1.5: .*body_inertia.*--no-models"):
        export(study, tree, tmp_path / "out", num_draws=2)
    assert not (tmp_path / "out").exists()
    assert export(study, tree, tmp_path / "out", num_draws=2, models=False)[0].read_text() == "inertia\n1.5\n1.5\n"


def test_command(tmp_path):
    toml = TOML.replace('varies = "trajectory"\n', "")
    study = make_study(tmp_path / "study", model_xml(HINGE), toml)
    fit, out = tmp_path / "fit", tmp_path / "out"
    run = CliRunner()
    made = run.invoke(cli.app, ["fit", str(study.folder), "--method", "prior", "--num-samples", "8", "--out", str(fit)])
    assert made.exit_code == 0, made.output
    asked = ["export", str(study.folder), str(fit / "fit.nc"), "--draws", "5", "--out", str(out), "--json"]
    told = run.invoke(cli.app, asked)
    assert told.exit_code == 0, told.output
    assert len(json.loads(told.stdout)["files"]) == 6
    draws = posterior.load(fit / "fit.nc")["posterior"]["mass"].values.ravel()
    rows = list(csv.DictReader((out / "psi.csv").open()))
    assert {float(r["mass"]) for r in rows} <= set(draws.tolist())
    missing = run.invoke(cli.app, ["export", str(study.folder), "nowhere.nc", "--out", str(out)])
    assert missing.exit_code == 2 and "nowhere.nc: no such file" in missing.output
