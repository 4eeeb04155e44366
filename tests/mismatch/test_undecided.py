"""Effects that are sure are named though another beside them cannot be told."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import PENDULUM, fit, noise_table, place, pose, recordings

from det2stoc_bayes.mismatch.compose import Composer
from det2stoc_bayes.mismatch.credence import weigh
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.explain import explain
from det2stoc_bayes.mismatch.judgement import judge
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.undecided import unmoved, without_undecided

TYPICAL = Typical(force=1.0, speed=2.0, span=1.0, inertia=0.07)
FRICTION = 0.02  # N m
NAMES = ("coulomb_friction", "quadratic_damping", "joint_spring", "constant_force")


def looked(folder, push):
    """A pendulum with friction and something else: pool, looks, and what is judged of the two."""

    def change(model):
        model.dof_frictionloss[0] = FRICTION

    starts = [([1.5], [0.0]), ([-0.7], [1.0]), ([0.3], [0.0]), ([-1.2], [0.5])]
    made = recordings(model_xml(PENDULUM), starts, 10 * np.arange(150), (2e-3, 2e-2), change=change, push=push)
    toml = (
        '[psi.damping]\ntarget = "joint/pivot/damping"\nprior = { LogNormal = { loc = -3.0, scale = 0.7 } }\n'
        + noise_table(2e-3, 2e-2)
    )
    study = pose(make_study(folder / "study", model_xml(PENDULUM), toml, made))
    pool, looks = [place(study, n, "pivot", TYPICAL) for n in NAMES], Looks()
    said = judge_of(explain(fit(study), pool, looks))
    assert said.verdict == "mismatch" and len(said.named) == 2
    return pool, looks, said


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """What pushes it to one side friction does not take up."""

    def push(model, data):
        data.qfrc_applied[0] = 0.01

    return looked(tmp_path_factory.mktemp("pushed"), push)


@pytest.fixture(scope="module")
def dragged(tmp_path_factory):
    """Drag is taken up in part by friction and damping."""

    def push(model, data):
        data.qfrc_applied[0] = -0.002 * abs(data.qvel[0]) * data.qvel[0]

    return looked(tmp_path_factory.mktemp("dragged"), push)


def judge_of(found):
    return judge(found.before, found, None)


def doubting(said, name):
    """The same judgement, were an effect as probable as what stands in the other place."""
    doubted, other = sorted(said.named, key=lambda n: n.placed.effect.name != name)
    half, rival = (replace(n.chosen, probability=0.5) for n in (doubted, other))
    named = [replace(n, chosen=half, rest=(rival,)) if n is doubted else n for n in said.named]
    places = tuple([half, rival] if doubted.chosen in p else p for p in said.places)
    return replace(said, verdict="inconclusive", named=tuple(named), places=places)


def names(said):
    return {n.placed.effect.name for n in said.named}


def test_what_is_sure_is_named(pushed):
    pool, looks, said = pushed
    rest = without_undecided(doubting(said, "constant_force"), judge_of, pool, looks)
    assert rest.verdict == "mismatch" and names(rest) == {"coulomb_friction"}
    assert [n.placed.effect.name for n in rest.undecided] == ["constant_force"]
    assert [e.effect.name for e in rest.shown.problem.effects] == ["coulomb_friction"]
    rest, credence = weigh(rest, 0)
    finding = Composer(rest, credence, [], 0).compose(1.0)
    (effect,) = finding.effects
    low, high = effect.parameters["force"].interval
    assert effect.name == "coulomb_friction" and low < FRICTION < high
    assert finding.candidates[0].name == "constant_force" and finding.experiment is not None
    assert "What else was left out the recordings do not tell: constant force on pivot (50%)" in finding.summary


def test_what_takes_up_the_open_effect_is_not_named(dragged):
    """Of friction alone 0.013 N m would be told for 0.02."""
    pool, looks, said = dragged
    doubted = doubting(said, "quadratic_damping")
    assert without_undecided(doubted, judge_of, pool, looks) is doubted


def test_the_open_effect_is_not_named_for_what_was_sure(dragged):
    """Beside drag, were friction the open one, friction is found again."""
    pool, looks, said = dragged
    doubted = doubting(said, "coulomb_friction")
    assert without_undecided(doubted, judge_of, pool, looks) is doubted


def test_what_is_sure_beside_the_other_alone_is_not(pushed):
    pool, looks, said = pushed
    doubted = doubting(said, "constant_force")
    assert without_undecided(doubted, lambda found: doubted, pool, looks) is doubted


def test_a_judgement_that_is_sure_stays(pushed):
    pool, looks, said = pushed
    assert without_undecided(said, judge_of, pool, looks) is said


@pytest.mark.parametrize(("other", "same"), [([1.0, 2.1], True), ([1.0, 2.5], False)])
def test_what_is_told_holds_other_values_within_two_sds(other, same):
    assert unmoved(np.array([1.0, 2.0]), np.diag([0.01, 0.04]), np.array(other)) == same
