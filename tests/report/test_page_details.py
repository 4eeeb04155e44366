"""What single parts of the pages say and show: classes, words, densities, intervals, where the replay opens."""

import base64
import json
from typing import Any

import numpy as np
import pytest
import xarray as xr
from made_results import write_results

from det2stoc_bayes.report import compare_figures, contents, diagnosis_page, marginals, replay, results, series
from det2stoc_bayes.report.results_page import list_page

NAMES = {"before": "before", "after": "after"}
MISMATCH = pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)


def _values(packed: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed["bdata"]), packed["dtype"])


def _classes(finding: dict[str, Any]) -> xr.DataTree:
    """Dry friction, another one that is as likely, what equals it, what contains it, and a class of its own."""
    names = ["viscous_damping", "stribeck_friction", "coulomb_friction", "hysteresis", "hard_stop", "armature"]
    wrist = finding["effects"][0]["element"]
    finding["effects"][0]["equivalent"] = [{"name": "viscous_damping", "element": wrist, "parameters": {}}]
    finding["effects"][0]["alternatives"] = [{"name": "hysteresis", "element": wrist, "probability": 0.03}]
    columns = {"name": names, "kind": ["joint"] * 6, "element": ["wrist"] * 6, "size": [""] * 6}
    columns |= {"log_evidence": np.arange(6.0, 0.0, -1.0), "probability": [0.97, 0.97, 0.97, 0.03, 0.0, 0.0]}
    table = xr.Dataset({key: ("candidate", value) for key, value in columns.items()})
    return xr.DataTree.from_dict({"/screening": table})


@MISMATCH
def test_a_class_has_one_probability(finding) -> None:
    rows = contents.screening_rows(_classes(finding), finding)
    assert [(row["name"], row["same"]) for row in rows] == [
        ("Coulomb friction", ""),  # what the finding names comes first
        ("viscous damping", "same class"),
        ("Stribeck friction", "same class, contains a simpler one"),
        ("hysteresis", ""),
        ("hard stop", ""),
        ("armature", ""),
    ]
    html = diagnosis_page(finding, _classes(finding), study_name="arm")
    table = html[html.index('<table class="explanations">') :]
    assert table[: table.index("</table>")].count("97 %") == 1


@MISMATCH
def test_a_class_that_the_finding_does_not_name_begins_with_the_best(finding) -> None:
    fit = _classes(finding)
    finding["effects"] = []
    rows = contents.screening_rows(fit, finding)
    assert [row["same"] for row in rows[:3]] == ["", "same class", "same class"]
    assert rows[0]["name"] == "viscous damping"


@MISMATCH
@pytest.mark.parametrize(("summary", "links"), [("It is missing.", 1), ("With psi <b> it is, psi.", 1), ("epsilon", 1)])
def test_the_first_psi_leads_to_what_it_means(finding, fit, summary, links) -> None:
    finding["summary"] = summary
    html = diagnosis_page(finding, fit, study_name="arm")
    assert html.count('href="#word-psi"') == links and "<b>" not in html[: html.index("</h1>")].split("<h1>")[1]
    head = html[: html.index("word-psi")]
    assert ("<h1>" in head) and ("</h1>" in head) == ("psi " not in summary)
    for word in ("held out", "whitened residual", "k-hat", "nat", "excess error", "prior tail"):
        assert f"<dt>{word}</dt>" in html
    assert html.index('class="words"') < html.index('id="provenance"')


def test_densities_end_at_nothing_or_at_zero() -> None:
    rng = np.random.default_rng(0)
    few = np.repeat(rng.normal(1.0, 1e-4, 40), 25)  # as weights leave them
    near_zero = np.abs(rng.normal(0.0, 0.1, 2000))
    for draws in (few, -few, rng.normal(0.0, 1.0, 500)):
        figure = marginals.density_figure(marginals.Marginal("a", "a", "", after=draws), NAMES)
        x, height = _values(figure["data"][0]["x"]), _values(figure["data"][0]["y"])
        assert max(height[0], height[-1]) < 0.02 * height.max()
        low, high = figure["layout"]["xaxis"]["range"]
        assert low < x[0] < draws.min() and draws.max() < x[-1] < high
        assert np.trapezoid(height, x) == pytest.approx(1.0, abs=0.02)
    figure = marginals.density_figure(marginals.Marginal("a", "a", "", after=near_zero), NAMES)
    assert _values(figure["data"][0]["x"]).min() >= 0 and figure["layout"]["margin"]["l"] >= 20


def test_intervals_do_not_touch_the_edge() -> None:
    draws = np.linspace(0.0, 1.0, 1001).reshape(1, -1)
    figure = compare_figures.forest_figure({"one": {"a": draws}, "two": {"a": draws + 1.0}}, "a")
    assert figure["layout"]["xaxis"]["range"] == pytest.approx([0.025 - 0.0975, 1.975 + 0.0975])
    same = compare_figures.forest_figure({"one": {"a": np.ones((1, 9))}}, "a")["layout"]["xaxis"]["range"]
    assert same[0] < 1 < same[1]


def _motions(finding: dict[str, Any], fit: xr.DataTree, names: dict[str, str] = NAMES) -> dict[str, Any]:
    told = replay.scene(fit, names, finding)
    assert told is not None
    return told["motions"]


@MISMATCH
def test_the_replay_opens_where_the_difference_is_largest_and_seen(finding, fit) -> None:
    motion = _motions(finding, fit)["swing_00"]
    poses = fit["replay/motions/swing_00"]
    apart = np.abs(poses["recorded"].values - poses["before"].values)[:, 1].sum(1)
    times = poses["time"].values
    assert apart[times == motion["worst"]] > 0.8 * np.nanmax(apart) and motion["factor"] == 3
    single = _motions(finding, fit, {"before": "model"})["swing_00"]
    assert "factor" not in single  # what one model leaves is noise
    assert "worst" not in _motions(finding, fit)["swing_01"]  # only sensors were recorded
    nodes = {path: node.to_dataset() for path, node in fit.subtree_with_keys if node.has_data}
    far = nodes["replay/motions/swing_00"].copy(deep=True)
    far["before"].values[40, 1, 0] += 1.0
    far["before"].values[50] = np.nan
    nodes["replay/motions/swing_00"] = far
    motion = _motions(finding, xr.DataTree.from_dict(nodes))["swing_00"]
    assert motion["worst"] == times[40] and motion["factor"] == 1


@MISMATCH
def test_without_a_replay_the_plots_open_where_residuals_are_largest(fit) -> None:
    rollout = fit["rollouts/swing_00"].to_dataset().copy(deep=True)
    rollout["residual_before"].values[123, 2] = 1e3
    rollout["residual_before"].values[5] = np.nan
    assert series.worst_moment(rollout) == rollout["time"].values[123]


def test_methods_of_a_doubtful_model_are_told_so(tmp_path) -> None:
    file = write_results(tmp_path) / "methods" / "comparison.json"
    assert results.read(tmp_path, "methods").verdict == "trusted"
    told = json.loads(file.read_text()) | {"doubts": ["the squared misfit is 13.6 times the noise"]}
    file.write_text(json.dumps(told))
    found = results.read(tmp_path, "methods")
    assert found.headline.endswith("to draw the posterior, of a model that the recordings speak against")
    assert '<span class="badge inconclusive">model in doubt</span>' in list_page([found], "here")
    told["rows"][0]["verdict"] = "do not trust"
    file.write_text(json.dumps(told))
    found = results.read(tmp_path, "methods")
    assert found.verdict == "not trusted" and found.headline.endswith("and the recordings speak against the model")


@pytest.mark.parametrize(("inflation", "warns"), [(1.02, False), (13.6, True), (float("nan"), False)])
def test_a_fit_with_misfit_warns_of_its_widths(tmp_path, monkeypatch, inflation, warns) -> None:
    draws = xr.Dataset({"mass": (("chain", "draw"), np.random.default_rng(0).normal(1.0, 0.1, (2, 100)))})
    tree = xr.DataTree.from_dict({"/posterior": draws, "/sample_stats": xr.Dataset()})
    tree.attrs = {"method": "laplace", "noise_inflation": inflation}
    monkeypatch.setattr("det2stoc_bayes.posterior.load", lambda _: tree)
    (tmp_path / "fit.nc").write_bytes(b"")
    found = results.read(tmp_path, ".")
    assert found.headline.endswith("; misfit 13.6 × noise: do not trust the widths") == warns
    assert found.headline.startswith("mass 1.")
