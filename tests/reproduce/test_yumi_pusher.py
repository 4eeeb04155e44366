"""YuMi Pusher as an experiment: what its scene tells the oracles and the figures, and a small run."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from det2stoc_bayes import cli
from det2stoc_bayes.reproduce import yumi_pusher
from det2stoc_bayes.reproduce.scene_figures import outlines
from det2stoc_bayes.reproduce.scores import known_oracle, population_oracle
from det2stoc_bayes.reproduce.seed_models import MARGINAL
from det2stoc_bayes.reproduce.work import Settings
from det2stoc_bayes.reproduce.yumi_pusher_scene import SCENE

TINY = Settings(1, 1, 20, 20, 200, 200, 200, 3, 40, 8, 0, False, (10,))


@pytest.fixture(scope="module")
def runs():
    """psi and four episodes under it."""
    random = np.random.default_rng(0)
    psi = SCENE.reality.draw(random, 4)
    return psi, SCENE.simulate(psi, random, lambda *_: None)


def test_under_its_own_psi_an_episode_is_missed_by_noise_alone(runs):
    psi, recorded = runs
    off = SCENE.change(recorded, np.repeat(psi, SCENE.num_steps, 0)) - recorded.transitions.change
    sd = np.sqrt(SCENE.noise_variance(recorded.transitions.state))
    seen = sd > 1e-5  # beyond what turns add to second order
    assert np.mean((off[seen] / sd[seen]) ** 2) == pytest.approx(1.0, abs=0.05)  # of 22,000 numbers: 0.01
    assert seen.mean() > 0.8


def test_oracles_know_ever_more(runs):
    """Densities of blocks add up; the true psi tells more than its population, most of it of the box's speed."""
    psi, recorded = runs
    known = known_oracle(SCENE, recorded, psi, lambda *_: None)
    drawn = SCENE.reality.draw(np.random.default_rng(1), 8)
    population = population_oracle(SCENE, recorded, drawn, lambda *_: None)
    for found in (known, population):
        assert sum(v for name, v in found.items() if name != "all") == pytest.approx(found["all"])
    gain = {name: known[name] - population[name] for name in known}
    assert gain["all"] > 1.0 and max(SCENE.blocks, key=lambda name: gain[name]) == "box velocity"


def test_both_psi_move_the_box_otherwise():
    middle = np.array(SCENE.reality.loc)
    paths = SCENE.swept(middle + np.array([[0, 0], [0.1, 0], [0, -0.03]]))
    np.testing.assert_allclose(paths[:, 0], paths[:1, 0].repeat(3, 0))
    assert (np.abs(paths[1:] - paths[0]).max((1, 2)) > 5e-4).all()


def test_outlines_stand_on_the_table(runs):
    psi, recorded = runs
    box, block = outlines(SCENE, recorded.states[0, -1], psi[0, 1])
    for found in (box, block):
        assert found[..., 2].min() == pytest.approx(0.051, abs=0.003)
    np.testing.assert_allclose(box.reshape(-1, 3).mean(0), recorded.states[0, -1, 42:45], atol=1e-9)


@pytest.mark.long
def test_a_small_run(tmp_path, monkeypatch):
    monkeypatch.setattr(yumi_pusher, "QUICK", TINY)
    answer = CliRunner().invoke(cli.app, ["reproduce", "yumi-pusher", "--quick", "--out", str(tmp_path)])
    assert answer.exit_code == 0, answer.output
    assert "oracle: psi from the truth" in answer.output
    result = json.loads((tmp_path / "results.json").read_text())
    matched = {r["name"]: r["metrics"]["matched"][0] for r in result["rows"]}
    assert list(matched) == ["baseline 1000", "det2stoc 1", MARGINAL]
    assert max(matched.values()) < result["oracles"]["population"] < result["oracles"]["known"]
    parts = result["rows"][0]["metrics"]
    assert sum(parts[name][0] for name in SCENE.blocks) == pytest.approx(matched["baseline 1000"], rel=1e-6)
    assert 'data-source="posterior-com"' in (tmp_path / "report.html").read_text()
