"""First-order additions: against least squares with bounds, written out."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from simulated import fit, spring_problem

from det2stoc_bayes.mismatch.addition import add
from det2stoc_bayes.mismatch.evidence import log_evidence
from det2stoc_bayes.problem import FARTHEST


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return fit(spring_problem(tmp_path_factory.mktemp("addition")), free_scale=False)


def equations(base, columns):
    """J'J and J'r of the unknowns' columns and of added ones, initial states projected out."""
    lin = base.linear
    j, r = lin.latent.project(lin.columns), lin.latent.project(lin.stacked)[..., 0]
    x = np.concatenate([j, lin.latent.project(lin.latent.stack(columns))], -1)
    flat = x.reshape(-1, x.shape[-1])
    return flat.T @ flat, flat.T @ r.reshape(-1), flat, r.reshape(-1)


def random_columns(base, count, seed):
    shape = (base.problem.segments.count, base.problem.weight.shape[1], count)
    return np.random.default_rng(seed).normal(size=shape) / np.maximum(base.problem.weight[..., None], 1e-9) / 30


@pytest.mark.parametrize("seed", range(6))
def test_signs_hold_as_in_bounded_least_squares(base, seed):
    gram, slope, flat, r = equations(base, random_columns(base, 3, seed))
    size, sd = base.problem.size, np.full(3, 5.0)
    found = add(base, gram, slope, sd, np.array([True, True, False]))
    prior = np.concatenate([np.ones(size), 1 / sd])
    left = np.concatenate([flat / np.sqrt(base.noise_scale), np.diag(prior)])
    right = np.concatenate([r / np.sqrt(base.noise_scale), -base.point.z, np.zeros(3)])
    low = np.concatenate([np.full(size, -np.inf), [0.0, 0.0, -np.inf]])
    expected = lsq_linear(left, right, (low, np.inf), tol=1e-12).x
    assert found is not None
    # The noise scale may follow the smaller misfit; measured: 1e-4.
    np.testing.assert_allclose(found.coefficients, expected[size:], atol=2e-2)
    assert (found.coefficients[:2] >= 0).all()


def test_nothing_is_left_where_every_sign_is_wrong(base):
    columns = random_columns(base, 1, 0)
    gram, slope, *_ = equations(base, columns)
    sign = np.sign(slope[-1] - gram[-1, :-1] @ np.linalg.solve(gram[:-1, :-1], slope[:-1]))
    wrong = equations(base, -sign * columns)
    right = equations(base, sign * columns)
    assert add(base, *wrong[:2], np.ones(1), np.array([True])) is None
    assert add(base, *right[:2], np.ones(1), np.array([True])) is not None


def test_psi_stays_in_its_support(base):
    """A column that psi would follow far beyond what its prior allows stops at the bound."""
    lin, size = base.linear, base.problem.size
    gram, slope, *_ = equations(base, random_columns(base, 1, 1))
    slope = slope.copy()
    slope[:size] -= 1e3 * gram[:size, :size] @ np.ones(size)  # the recordings ask for psi far below
    found = add(base, gram, slope, np.ones(1), np.array([False]))
    assert found is not None
    low = np.full(size, -np.inf)
    psi = [b.begin for b in base.problem.unknowns.blocks]
    far = np.array(lin.point.z)
    far[psi] = -FARTHEST
    low[psi] = base.problem.straightened(far, lin.point.z)[psi]
    assert (found.change >= low - 1e-9).all() and np.isclose(found.change, low).any()


def test_a_small_addition_is_weighed_as_by_laplace(base):
    """Against the evidence of the fit with the column as an unknown more, for which everything is linear."""
    columns = random_columns(base, 1, 2)
    gram, slope, *_ = equations(base, columns)
    found = add(base, gram, slope, np.ones(1), np.array([False]))
    assert found is not None and np.isfinite(log_evidence(base))
    precision = gram / base.noise_scale + np.eye(len(gram))
    pull = slope / base.noise_scale - np.append(base.point.z, 0.0)
    gain = 0.5 * pull @ np.linalg.solve(precision, pull)
    occam = 0.5 * (np.linalg.slogdet(precision)[1] + np.linalg.slogdet(base.covariance)[1])
    assert found.log_evidence == pytest.approx(gain - occam, abs=0.3)  # the noise scale is free to follow
