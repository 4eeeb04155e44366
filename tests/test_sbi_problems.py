"""Problems of the SBI benchmark against its own files: observations and reference posteriors."""

import sys
from importlib import util
from pathlib import Path

import jax
import numpy as np
import pytest

from det2stoc_bayes.inference._amortized import Options
from det2stoc_bayes.inference._cvae import Schedule
from det2stoc_bayes.models import gaussian_linear, slcp, two_moons

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import compare_sbi  # noqa: E402
import cvae_of_vectors  # noqa: E402

PROBLEMS = (gaussian_linear.PROBLEM, slcp.PROBLEM, two_moons.PROBLEM)
NUM_PRIOR = 1_000_000
WITHIN = 5.0  # standard errors; measured: 3.2 at most


def files(name, observation):
    """x and draws of the reference posterior."""
    found = util.find_spec("sbibm")
    assert found is not None and "sbibm" not in sys.modules  # it is not imported: it would want PyTorch
    folder = Path(found.submodule_search_locations[0]) / "tasks" / name / "files" / f"num_observation_{observation}"
    x, draws = (
        np.loadtxt(folder / file, delimiter=",", skiprows=1, ndmin=2)
        for file in ("observation.csv", "reference_posterior_samples.csv.bz2")
    )
    return x[0], draws


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_prior_and_likelihood_give_the_reference_posterior(problem):
    """Means of theta, |theta| and theta^2 by draws of the prior that are weighed by the likelihood."""
    x, reference = files(problem.name, 1)
    theta = problem.constrained(np.random.default_rng(0).standard_normal((NUM_PRIOR, problem.size)))
    log_weight = problem.log_likelihood(theta, x)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    theta, weight = theta[weight > 1e-12], weight[weight > 1e-12]
    effective = 1 / (weight**2).sum()
    assert effective > 100
    for of in (lambda t: t, np.abs, np.square):
        values, wanted = of(theta), of(reference)
        mean = weight @ values
        error = np.sqrt(weight**2 @ (values - mean) ** 2 + wanted.var(0) / len(wanted))
        assert np.abs((mean - wanted.mean(0)) / error).max() < WITHIN


@pytest.mark.parametrize("problem", PROBLEMS[:2], ids=lambda p: p.name)
def test_the_simulator_draws_from_the_likelihood(problem):
    """E[p(x | other) / p(x | theta)] = 1 for x ~ p(x | theta)."""
    random = np.random.default_rng(1)
    theta = np.full((1, problem.size), 0.9)
    x = problem.simulate(np.repeat(theta, 2_000, 0), random)
    for k in range(problem.size):
        other = theta + 0.05 * np.eye(problem.size)[k]
        ratio = np.exp(
            [float(problem.log_likelihood(other, one)[0] - problem.log_likelihood(theta, one)[0]) for one in x]
        )
        assert abs(ratio.mean() - 1) < WITHIN * ratio.std() / np.sqrt(len(x))


def test_moons_are_drawn_where_the_benchmark_has_them():
    """theta = 0: a half circle of radius 0.1 about (0.25, 0)."""
    x = two_moons.PROBLEM.simulate(np.zeros((20_000, 2)), np.random.default_rng(2))
    off = x - [0.25, 0.0]
    radius = np.hypot(*off.T)
    assert (off[:, 0] >= 0).all() and abs(radius.mean() - 0.1) < 5 * 0.01 / np.sqrt(20_000)
    assert abs(radius.std() - 0.01) < 5 * 0.01 / np.sqrt(40_000)
    moved = two_moons.PROBLEM.simulate(np.tile([0.3, -0.7], (20_000, 1)), np.random.default_rng(2)) - x
    np.testing.assert_allclose(moved, np.tile([-0.4, -1.0], (20_000, 1)) / np.sqrt(2), atol=1e-12)


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_theta_and_back(problem):
    z = np.random.default_rng(3).standard_normal((50, problem.size))
    np.testing.assert_allclose(problem.unconstrained(problem.constrained(z)), z, atol=1e-9)
    x = problem.simulate(problem.constrained(z), np.random.default_rng(4))
    expected = problem.log_likelihood(problem.constrained(z), x[0]) - 0.5 * (z**2 + np.log(2 * np.pi)).sum(1)
    np.testing.assert_allclose(problem.log_density(z, x[0]), expected)


def test_seeds_of_an_observation_are_no_further_evidence():
    """Two observations whose seeds agree: the standard error is that of two values, however many seeds there are."""
    scores = {"npe": [0.6, 0.8], "npe+psis": [0.5, 0.5], "k_hat": [0.2, 0.71]}
    one = {"problem": "two_moons", "simulations": 1000, "seconds": 10.0} | scores
    for count in (1, 5):
        lines = [one | {"seed": k} for k in range(count)]
        told = list(compare_sbi.summary([lines[0] | {"seconds": 99.0}, *lines]))[-1]  # of a seed the last line counts
        assert told == f"| two_moons | 1000 | 0.700 ± 0.100 | 0.500 ± 0.000 | 1 of 2 | 0.725 | {count} | 10 |  | 0 |"
    beside = {"problem": "two_moons", "simulations": 1000, "seed": 0, "seconds": 1.0, "det2stoc": [0.9, 0.7]}
    assert list(compare_sbi.summary([*lines, beside]))[-1].endswith("| 5 | 10 | 0.800 ± 0.100 | 1 |")


def test_the_cvae_beside_them_reads_a_linear_gaussian_backwards():
    """x = z + sd noise: the posterior is normal about x / (1 + sd^2) with variance sd^2 / (1 + sd^2)."""
    random, sd = np.random.default_rng(0), 0.5
    z = random.standard_normal((4000, 2))
    brief = Schedule(num_steps=1200, batch=256, learning_rate=3e-3, checks=12)
    options = Options(full=True, dropout=0.0, alpha=1.0, width=32, decoder=brief, encoder=brief)
    learned = cvae_of_vectors.train(z, z + sd * random.standard_normal(z.shape), jax.random.key(0), options)
    for x in ([0.8, -0.4], [-1.0, 0.0]):
        draws = learned.sample(jax.random.key(1), np.array(x), 4000)
        wanted = sd / np.sqrt(1 + sd**2)
        np.testing.assert_allclose(draws.mean(0), np.array(x) / (1 + sd**2), atol=0.25 * wanted)
        np.testing.assert_allclose(draws.std(0), wanted, rtol=0.15)
