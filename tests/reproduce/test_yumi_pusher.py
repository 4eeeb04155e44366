"""YuMi Pusher as an experiment: what its scene tells the oracles and the figures, and a small run."""

import json

import jax
import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from det2stoc_bayes import cli
from det2stoc_bayes.reproduce import yumi_pusher, yumi_pusher_exact
from det2stoc_bayes.reproduce.scene_figures import outlines
from det2stoc_bayes.reproduce.scores import known_oracle, population_oracle
from det2stoc_bayes.reproduce.seed_models import MARGINAL
from det2stoc_bayes.reproduce.work import Settings, Work
from det2stoc_bayes.reproduce.yumi_pusher_exact import log_posterior, population
from det2stoc_bayes.reproduce.yumi_pusher_scene import SCENE
from det2stoc_bayes.transitions import Transitions

TINY = Settings(1, 1, 20, 20, 200, 200, 200, 3, 40, 8, 0, False, (10,), episode_steps=40, num_particles=8)


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


def test_the_population_of_episodes_that_are_known(tmp_path):
    """Their mean, and a sd about theirs: with ten of them a tenth above it."""
    sample = np.random.default_rng(2).normal(SCENE.reality.loc, SCENE.reality.scale, (10, 2))
    covariances = np.tile(np.diag([0.002, 0.0005]) ** 2, (10, 1, 1))
    found = population(sample, covariances, Work(tmp_path, SCENE, TINY, 0, lambda *_: None), 0)
    np.testing.assert_allclose(found["mean"], sample.mean(0), atol=0.15 * sample.std(0).min(), rtol=0.02)
    assert (np.abs(found["sd"] / sample.std(0, ddof=1) / 1.1 - 1) < 0.15).all()


def test_psi_0_ends_the_posterior():
    def likelihood(psi):
        return -((psi / 0.1) ** 2).sum(1)

    psi = np.array([[0.2, 0.0], [0.05, 0.0], [0.2, 0.06]])
    np.testing.assert_allclose(log_posterior(likelihood, psi), [-4.0, -np.inf, -np.inf])


def test_particles_become_the_posterior(monkeypatch):
    """Of a normal likelihood; what a psi outside of psi_0 would add is left out. Networks stay in single precision."""
    centre, sd = np.array([0.28, 0.0495]), np.array([0.002, 0.0005])

    class Known:
        actions = np.zeros((30, 14))

        def __call__(self, psi):
            return -0.5 * (((psi - centre) / sd) ** 2).sum(1)

    monkeypatch.setattr(yumi_pusher_exact, "mode", lambda *_: (Known(), centre, np.diag(sd**-2.0)))
    before = jax.config.jax_enable_x64
    recorded = Transitions(np.zeros((1, 60)), np.zeros((1, 14)), np.zeros((1, 60)), np.zeros(1, int))
    found = yumi_pusher_exact.episode_posterior(recorded, 2000, np.random.default_rng(0), 0)
    cut = stats.truncnorm(-np.inf, 1.0, centre[1], sd[1])
    error = 5 / np.sqrt(2000 / 3)  # resampled particles repeat each other
    assert abs(found["mean"][0] - centre[0]) < error * sd[0]
    assert abs(found["mean"][1] - cut.mean()) < error * sd[1]
    np.testing.assert_allclose(np.sqrt(np.diag(found["covariance"])), [sd[0], cut.std()], rtol=0.15)
    assert jax.config.jax_enable_x64 == before


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
    page = (tmp_path / "report.html").read_text()
    assert 'data-source="posterior-com"' in page and 'data-source="episodes-friction"' in page
    (exact,) = result["exact"]
    drawn, inferred = np.array(exact["drawn"]), np.array(exact["mean"])
    assert (np.abs(inferred - drawn) < [0.02, 0.005]).all()  # measured with so few starts: 0.01, 2.2 mm
    assert [row[:2] for row in result["populations"]["rows"]] == [["friction", "0"], ["com", "0"]]
    assert "exact" in answer.output
