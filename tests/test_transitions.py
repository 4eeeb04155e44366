"""Units of transitions."""

import numpy as np
import pytest
from scipy import stats

from det2stoc_bayes.transitions import Scaling, Transitions


def linear(count=2000):
    random = np.random.default_rng(0)
    state, action = random.normal(3.0, 2.0, (count, 2)), random.normal(-1.0, 0.1, (count, 1))
    change = state @ [[0.5, 0.0], [0.1, -0.3]] + 7 * action + [4.0, 0.0] + 0.01 * random.standard_normal((count, 2))
    return Transitions(state, action, change, np.zeros(count, int))


def test_episodes_become_rows():
    states = np.arange(24.0).reshape(2, 4, 3) ** 2
    rows = Transitions.of_episodes(states, np.zeros((2, 3, 1)))
    assert len(rows) == 6
    np.testing.assert_array_equal(rows.state + rows.change, states[:, 1:].reshape(6, 3))
    np.testing.assert_array_equal(rows.episode, [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(rows[2:4].episode, [0, 1])


def test_what_is_linear_in_the_inputs_is_taken_away():
    data = linear()
    scaling = Scaling.of(data)
    np.testing.assert_allclose(scaling.change_sd, 0.01, rtol=0.05)
    x, y = scaling.standard(data)
    np.testing.assert_allclose(np.concatenate([x.std(0), y.std(0)]), 1.0, rtol=1e-4)
    np.testing.assert_allclose(scaling.linear(data.given) + y * scaling.change_sd, data.change, atol=1e-6)
    alone = Scaling.of(data, linear=False)
    np.testing.assert_allclose(alone.change_sd, data.change.std(0))
    np.testing.assert_allclose(alone.linear(data.given), np.tile(data.change.mean(0), (len(data), 1)), rtol=1e-5)


def test_densities_change_with_the_units():
    data = linear()
    scaling = Scaling.of(data)
    _, y = scaling.standard(data)
    own = stats.norm.logpdf(data.change, scaling.linear(data.given), scaling.change_sd).sum(1)
    np.testing.assert_allclose(stats.norm.logpdf(y).sum(1) - scaling.log_volume, own, rtol=1e-4)


def test_what_never_changes_keeps_its_unit():
    data = linear()
    still = Transitions(np.ones_like(data.state), data.action * 0, np.ones_like(data.change), data.episode)
    scaling = Scaling.of(still)
    x, y = scaling.standard(still)
    assert not x.any()
    assert y == pytest.approx(np.zeros_like(y), abs=1e-5)
