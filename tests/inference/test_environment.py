"""The Gymnasium environment: its contract, one latent an episode, the seed."""

import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.inference._environment import StochasticEnv
from det2stoc_bayes.inference._networks import Decoder
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.transitions import Scaling


@pytest.fixture
def environment():
    decoder = Decoder(3, 2, 2, jax.random.key(0))
    scaling = Scaling(np.zeros(3), np.ones(3), np.zeros((4, 2)), np.array([0.1, 0.2]))
    simulator = StochasticSimulator(decoder, scaling)
    reward = lambda state, action, after: -float(after @ after)  # noqa: E731
    return StochasticEnv(simulator, np.array([[0.0, 1.0], [0.5, -1.0]]), -np.ones(1), np.ones(1), 5, reward)


def episode(environment, seed):
    states = [environment.reset(seed=seed)[0]]
    while True:
        state, reward, ended, truncated, _ = environment.step(np.array([0.3]))
        assert reward == pytest.approx(-state @ state)
        states.append(state)
        if ended or truncated:
            return np.array(states)


def test_it_is_an_environment(environment):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of unbounded observations
        check_env(environment, skip_render_check=True)


def test_episodes_follow_from_the_seed(environment):
    one = episode(environment, 3)
    assert one.shape == (6, 2)
    np.testing.assert_array_equal(one, episode(environment, 3))
    assert not np.array_equal(one, episode(environment, 4))
    assert {tuple(episode(environment, k)[0]) for k in range(8)} == {(0.0, 1.0), (0.5, -1.0)}


def test_a_latent_stays_for_an_episode(environment):
    environment.reset(seed=0)
    first = np.asarray(environment._z)
    environment.step(np.zeros(1))
    np.testing.assert_array_equal(environment._z, first)
    environment.reset()
    assert not np.array_equal(environment._z, first)


def test_a_step_before_a_reset_is_an_error(environment):
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(np.zeros(1))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"starts": np.zeros((2, 3))}, r"starts: found shape \(2, 3\); allowed: \(rows, 2\)"),
        ({"starts": np.zeros((0, 2))}, "found 0 starts and 5 steps; allowed: one at least"),
        ({"starts": np.full((1, 2), np.nan)}, "allowed: one at least of either, all finite"),
        ({"num_steps": 0}, "found 2 starts and 0 steps"),
        ({"action_low": -np.ones(2), "action_high": np.ones(2)}, r"found shape \(2, 2\); allowed: \(rows, 1\)"),
        ({"action_low": np.ones(1), "action_high": -np.ones(1)}, "allowed: low at most high"),
    ],
)
def test_what_the_simulator_cannot_take_is_an_error(environment, change, said):
    whole = {"starts": environment.starts, "action_low": -np.ones(1), "action_high": np.ones(1), "num_steps": 5}
    with pytest.raises(Det2StocError, match=said):
        StochasticEnv(environment.simulator, **(whole | change))
