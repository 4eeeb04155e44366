"""The population that CMA-ES finds, against the psi that were drawn."""

from dataclasses import replace

import numpy as np
import pytest
from test_populations import COUNT, springs

from det2stoc_bayes.errors import MethodNotApplicable
from det2stoc_bayes.inference import population_search
from det2stoc_bayes.models import linear_gaussian


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    problem, truth = springs(tmp_path_factory.mktemp("springs") / "study", holdout=0)
    return population_search.fit(problem, 0, num_samples=200), truth[:COUNT]


@pytest.mark.long
def test_it_finds_mean_and_spread(found):
    """Twelve recordings tell a mean to 0.29 of their sd, and the sd to 20 %."""
    tree, truth = found
    mu, sigma = (float(tree.posterior[f"stiffness_{n}"].mean()) for n in ("mu", "sigma"))
    assert mu == pytest.approx(truth.mean(), abs=truth.std() * 0.5)  # measured: 0.0; of another seed 0.4
    assert sigma == pytest.approx(truth.std(ddof=1), rel=0.4)  # measured: 0.0


@pytest.mark.long
def test_draws_are_the_population_s(found):
    tree, _ = found
    assert np.ptp(tree.posterior["stiffness_mu"].values) == 0
    values, sigma = tree.posterior["stiffness"].values.ravel(), float(tree.posterior["stiffness_sigma"][0, 0])
    assert values.std() == pytest.approx(sigma, rel=4 / np.sqrt(2 * len(values)))


@pytest.mark.long
def test_the_discrepancy_falls(found):
    """To what recordings that scatter have among themselves; measured: 56.4 to 53.1."""
    history = found[0].sample_stats.discrepancy.values
    assert history[-5:].mean() < history[:3].mean() - 1


def test_what_never_varies_comes_out_narrow(gaussian_problem):
    """Where nothing varies the recordings scatter by their noise alone, and the spread falls."""
    tree = population_search.fit(gaussian_problem, 0, num_samples=400)
    mean, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    for i, name in enumerate(("gravity_x", "gravity_z")):
        draws, sd = tree.posterior[name].values, np.sqrt(covariance[i, i])
        assert abs(draws.mean() - mean[i]) < 2 * sd  # measured: 0.01 and 0.22 sds
        assert draws.std() < 3 * sd  # measured: 0.03 and 1.3 sds


def test_without_psi_there_is_nothing_to_search(gaussian_problem):
    simulator = gaussian_problem.simulator
    bare = replace(gaussian_problem, simulator=type(simulator)(replace(simulator.study, parameters=())))
    with pytest.raises(MethodNotApplicable, match="no psi"):
        population_search.fit(bare, 0)
