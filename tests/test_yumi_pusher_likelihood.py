"""The likelihood of YuMi Pusher's recorded transitions: its noise, its starts, and where it is highest."""

import numpy as np
import pytest

from det2stoc_bayes.models import yumi_pusher
from det2stoc_bayes.models.yumi_pusher_likelihood import EpisodeLikelihood, Starts, misses, mode, stepped
from det2stoc_bayes.models.yumi_pusher_policy import Pusher


@pytest.fixture(scope="module")
def recorded():
    """psi and four episodes under it."""
    random = np.random.default_rng(0)
    psi, start = yumi_pusher.REALITY.draw(random, 4), yumi_pusher.drawn_starts(random, 4)
    return psi, yumi_pusher.simulate(psi, start, lambda _: Pusher(random), random)


def test_misses_at_the_truth_are_standard_normals(recorded):
    """In each of 52 numbers, of which none follows from others."""
    _, runs = recorded
    found = misses(runs.full.reshape(-1, 41), runs.states.reshape(-1, 60))
    np.testing.assert_allclose(found.mean(0), 0, atol=4 / np.sqrt(len(found)))
    np.testing.assert_allclose(np.cov(found.T), np.eye(52), atol=0.25)  # 5 standard errors of 404 rows


def test_the_simulator_s_state_is_among_the_starts(recorded):
    """As far from their centre as is told; where a hand is tells its arm's joints better than they do themselves."""
    _, runs = recorded
    seen, full = runs.states.reshape(-1, 60), runs.full.reshape(-1, 41)
    starts = Starts.of(seen)
    for i in range(2):
        off = full[:, 7 + 7 * i : 14 + 7 * i] - starts.centre[:, 7 + 7 * i : 14 + 7 * i]
        white = np.linalg.solve(starts.joints[:, i], off[..., None])[..., 0]
        np.testing.assert_allclose((white**2).mean(0), 1.0, atol=0.4)
        assert (off**2).mean() < 0.5 * ((full - starts.centre)[:, 27:] ** 2).mean()
    draws = starts.draw(np.random.default_rng(1), 40)
    np.testing.assert_allclose(draws.mean(0)[:, 7:], starts.centre[:, 7:], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(draws[..., 3:7], axis=-1), 1.0)
    spread = (draws - starts.centre)[..., [0, 21, 27]].std((0, 1))
    np.testing.assert_allclose(spread, [1e-4, 1e-3, 1e-3], rtol=0.05)


def test_a_step_is_the_episode_s_own(recorded):
    """But for the solver, which starts anew."""
    psi, runs = recorded
    found = stepped(psi[:1], runs.full[:1, :-1], runs.actions[0])
    np.testing.assert_allclose(found[0], runs.full[0, 1:], atol=1e-4)


def test_an_episode_is_missed_by_what_its_starts_leave_open(recorded):
    """At its own psi; and far more under another."""
    psi, runs = recorded
    told = runs[:1].transitions[20:60]
    likelihood = EpisodeLikelihood.at(psi[0], told, np.random.default_rng(0), 4, 120)
    tried = psi[0] + np.array([[0, 0], [0.05, 0], [0, -0.02]])
    # 120 starts leave the inverse of 52 numbers' covariance uncertain: measured 0.98 to 1.06.
    assert np.mean(likelihood.white(tried[:1]) ** 2) == pytest.approx(1.0, abs=0.15)
    found = likelihood(tried)
    assert found[0] > found[1] + 30 and found[0] > found[2] + 30


def test_the_most_likely_psi_is_near_the_truth(recorded):
    """From psi_0's middle; measured: friction within 0.004, com within 1 mm."""
    psi, runs = recorded
    likelihood, found, precision = mode(runs[:1].transitions, np.random.default_rng(0), 4, 100)
    assert 20 < len(likelihood.actions) < 100  # those that tell something
    assert (np.abs(found - psi[0]) < [0.012, 0.003]).all()
    sd = np.sqrt(np.diag(np.linalg.inv(precision)))
    assert (sd < [0.005, 0.0015]).all() and (sd > [0.0005, 0.0001]).all()
