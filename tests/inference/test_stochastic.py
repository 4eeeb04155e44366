"""The learned simulator: its draws against its own density, rollouts, files."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.inference._networks import Decoder
from det2stoc_bayes.inference._stochastic import StochasticSimulator, rows_of
from det2stoc_bayes.transitions import Scaling, Transitions


@pytest.fixture(scope="module")
def simulator():
    decoder = Decoder(3, 2, 2, jax.random.key(0), width=16, depth=2)
    scaling = Scaling(np.array([1.0, 0, 0]), np.array([2.0, 1, 1]), np.full((4, 2), 0.1), np.array([0.5, 2.0]))
    return StochasticSimulator(decoder, scaling)


@pytest.fixture(scope="module")
def data():
    random = np.random.default_rng(0)
    state, action, change = (random.standard_normal((5, n)) for n in (2, 1, 2))
    return Transitions(state, action, change, np.arange(5))


def test_draws_and_densities_agree(simulator, data):
    """E over draws of exp(log p(y | z)) is the density that a histogram of the draws shows."""
    draws, terms = simulator.draws(jax.random.key(1), data, 20_000)
    assert draws.shape == (20_000, 5, 2)
    density = np.exp(terms).mean(0)
    half = 0.15 * draws.std(0)
    inside = (np.abs(draws - data.change) < half).all(-1).mean(0) / (4 * half.prod(-1))
    error = np.sqrt(inside / (20_000 * 4 * half.prod(-1)))
    assert (np.abs(inside - density) < 5 * error + 0.03 * density).all()


def test_samples_are_the_draws(simulator, data):
    many = Transitions(*(np.repeat(a, 4000, 0) for a in (data.state, data.action, data.change, data.episode)))
    after = simulator.sample(jax.random.key(2), many.state, many.action) - many.state
    draws, _ = simulator.draws(jax.random.key(3), data, 4000)
    error = draws.std(0) / np.sqrt(4000)
    assert (np.abs(after.reshape(5, 4000, 2).mean(1) - draws.mean(0)) < 5 * error).all()


def test_an_episode_keeps_its_latent(simulator):
    still = eqx.tree_at(
        lambda d: (d.net.last.weight, d.net.last.bias),
        simulator.decoder,
        replace_fn=lambda a: a.at[2:].set(0.0) if a.ndim > 1 else a.at[2:].set(-10.0),
    )
    certain = StochasticSimulator(still, simulator.scaling)
    state, actions = np.zeros((400, 2)), np.zeros((400, 2, 1))
    held, anew = (np.diff(certain.rollout(jax.random.key(0), state, actions, hold=h), axis=1) for h in (True, False))
    assert held.shape == (400, 2, 2)

    def alike(steps):
        return abs(np.corrcoef(steps[:, 0, 0], steps[:, 1, 0])[0, 1])

    assert alike(held) > 0.5 > alike(anew)


def test_files(simulator, data, tmp_path):
    simulator.save(tmp_path / "a.d2s")
    again = StochasticSimulator.load(tmp_path / "a.d2s")
    one, two = (s.sample(jax.random.key(5), data.state, data.action) for s in (simulator, again))
    np.testing.assert_array_equal(one, two)
    (tmp_path / "b.d2s").write_text("{}")
    whole = (tmp_path / "a.d2s").read_bytes()
    (tmp_path / "c.d2s").write_bytes(whole[: whole.index(b"\n") + 1])
    (tmp_path / "d.d2s").write_bytes(whole[: len(whole) // 2])
    for name in ("absent.d2s", "b.d2s", "c.d2s", "d.d2s"):
        with pytest.raises(Det2StocError, match=f"{name}: found no stochastic simulator; allowed: a file that"):
            StochasticSimulator.load(tmp_path / name)


@pytest.mark.parametrize(
    ("shape", "count", "said"),
    [
        ((5, 3), None, r"state: found shape \(5, 3\); allowed: \(rows, 2\)"),
        ((2,), None, r"state: found shape \(2,\); allowed: \(rows, 2\)"),
        ((3, 2), 5, r"state: found shape \(3, 2\); allowed: \(5, 2\)"),
    ],
)
def test_rows_of_another_size_are_errors(shape, count, said):
    with pytest.raises(Det2StocError, match=said):
        rows_of("state", np.zeros(shape), 2, count)


def test_states_and_actions_are_those_that_were_learned_from(simulator, data):
    assert (simulator.num_states, simulator.num_actions) == (data.state.shape[1], data.action.shape[1])
    key, wide = jax.random.key(0), np.zeros((5, simulator.num_states + 1))
    with pytest.raises(Det2StocError, match="state: found shape"):
        simulator.sample(key, wide, np.zeros((5, simulator.num_actions)))
    with pytest.raises(Det2StocError, match="action: found shape"):
        simulator.sample(key, wide[:, 1:], np.zeros((5, simulator.num_actions + 1)))


def test_next_states_hold_rotations():
    random = np.random.default_rng(0)
    decoder = Decoder(10, 1, 10, jax.random.key(0))
    scaling = Scaling(np.zeros(10), np.ones(10), np.zeros((11, 10)), np.full(10, 0.3))
    state = np.concatenate([random.standard_normal((50, 1)), np.tile(np.eye(3).ravel(), (50, 1))], 1)
    loose, valid = (StochasticSimulator(decoder, scaling, rotations) for rotations in ((), (1,)))
    after, raw = (s.sample(jax.random.key(1), state, np.zeros((50, 0))) for s in (valid, loose))
    turns, free = (a[:, 1:].reshape(-1, 3, 3) for a in (after, raw))
    assert np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() < 1e-6
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-6)
    np.testing.assert_array_equal(after[:, 0], raw[:, 0])
    # Nearest: no small turn comes nearer.
    for axis in np.eye(3):
        for angle in (-1e-3, 1e-3):
            turned = turns @ Rotation.from_rotvec(angle * axis).as_matrix()
            assert (((turned - free) ** 2).sum((1, 2)) >= ((turns - free) ** 2).sum((1, 2)) - 1e-12).all()


def test_files_hold_where_rotations_are(simulator, tmp_path):
    turning = StochasticSimulator(simulator.decoder, simulator.scaling, (0,))
    turning.save(tmp_path / "one.d2s")
    assert StochasticSimulator.load(tmp_path / "one.d2s").rotations == (0,)
