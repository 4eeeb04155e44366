"""One small study with a known posterior, and every method's fit of it, made once."""

from pathlib import Path

import pytest

from det2stoc_bayes.inference import get_method
from det2stoc_bayes.models import linear_gaussian
from det2stoc_bayes.problem import Problem, make_problem
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import load_study

GRAVITY = (0.3, -0.1)
KEY = 2


@pytest.fixture(scope="session")
def gaussian_study(tmp_path_factory) -> Path:
    return linear_gaussian.write_study(tmp_path_factory.mktemp("studies") / "slides", GRAVITY, seed=1)


@pytest.fixture(scope="session")
def gaussian_problem(gaussian_study) -> Problem:
    return make_problem(Simulator(load_study(gaussian_study)))


@pytest.fixture(scope="session")
def gaussian_problem_mjx(gaussian_study) -> Problem:
    return make_problem(Simulator(load_study(gaussian_study), engine="mjx"))


@pytest.fixture(scope="session")
def fits(gaussian_problem):
    """A method's fit by name, each run once."""
    made = {}

    def fit(name: str):
        if name not in made:
            made[name] = get_method(name).fit(gaussian_problem, KEY, num_samples=1000)
        return made[name]

    return fit
