"""The score of recordings among simulations: uniform p-values under the right model, the least under a wrong one."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from conftest import make_study, model_xml
from scipy.stats import kstest
from simulated import SPRING, SPRING_PSI, noise_table, pose, recordings

from det2stoc_bayes.doubts import surprising
from det2stoc_bayes.inference import det2stoc
from det2stoc_bayes.inference._surprise import Surprise, mean_surprise, surprise
from det2stoc_bayes.posterior import DataTree, with_groups
from det2stoc_bayes.study_transitions import StudyTransitions

NOISE = (0.002, 0.01)
STARTS = [([0.3], [0.0]), ([-0.2], [1.0]), ([0.1], [-1.5])]
STEPS = 10 * np.arange(41)
NUM_STUDIES = 30


def study_transitions(folder, seed, friction=0.0):
    """Of a mass on a spring under psi from the prior; with dry friction [N] where the model has none."""
    random = np.random.default_rng(seed)
    damping, stiffness = random.normal(0.4, 0.1), random.normal(30, 3)

    def change(model):
        model.dof_damping[0], model.jnt_stiffness[0], model.dof_frictionloss[0] = damping, stiffness, friction

    made = recordings(model_xml(SPRING), STARTS, STEPS, NOISE, seed=seed, change=change)
    return StudyTransitions.of(
        pose(make_study(folder / f"s{seed}", model_xml(SPRING), SPRING_PSI + noise_table(*NOISE), made))
    )


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Transitions of a study, and the first turn on it."""
    own = study_transitions(tmp_path_factory.mktemp("own"), 1000)
    turns = det2stoc._turns(own, own.recorded(), jax.random.key(0), 1, 2000, 1200)
    return own, next(turns)


@pytest.fixture(scope="module")
def judged(learned):
    return surprise(learned[1], learned[0], np.random.default_rng(0))


def of(learned, folder, seeds, **options):
    """Mean surprise of other studies."""
    own, turn = learned
    parts = [study_transitions(folder, seed, **options).recorded_by_stretch() for seed in seeds]
    return np.concatenate([mean_surprise(turn, part, own.stretches.count, varies=False) for part in parts])


@pytest.mark.long
def test_p_values_are_uniform_under_the_right_model(learned, judged, tmp_path):
    found = of(learned, tmp_path, range(NUM_STUDIES))
    p = [replace(judged, recorded=float(value)).p_value for value in found]
    assert kstest(p, "uniform").pvalue > 0.01, np.sort(p)


def test_dry_friction_that_no_simulation_has_is_mostly_noticed(learned, judged, tmp_path):
    found = of(learned, tmp_path, range(5), friction=1.0)
    p = [replace(judged, recorded=float(value)).p_value for value in found]
    assert sum(value < 0.05 for value in p) >= 4, (found, judged.simulated)


def test_a_fit_says_so_in_a_sentence():
    def tree(recorded):
        return with_groups(DataTree(), surprise=Surprise(recorded, np.linspace(-1.0, 1.0, 199)).told())

    assert surprising(tree(0.5)) == "" and surprising(DataTree()) == ""
    assert "unlike the simulations" in surprising(tree(3.0)) and "p = 0.005" in surprising(tree(3.0))
