"""Two additions that are found together, or not at all."""

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import PENDULUM, fit, noise_table, place, pose, recordings

from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.explain import explain
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.pairs import pairs
from det2stoc_bayes.mismatch.screen import screen

TYPICAL = Typical(force=1.0, speed=2.0, span=1.0, inertia=0.07)
NAMES = ("coulomb_friction", "quadratic_damping", "joint_spring", "constant_force")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A pendulum with friction and drag, of which damping alone can imitate either at one amplitude."""

    def change(model):
        model.dof_frictionloss[0] = 0.02

    def push(model, data):
        data.qfrc_applied[0] = -0.01 * abs(data.qvel[0]) * data.qvel[0]

    starts = [([1.5], [0.0]), ([-0.7], [1.0]), ([0.3], [0.0])]
    made = recordings(model_xml(PENDULUM), starts, 10 * np.arange(150), (2e-3, 2e-2), change=change, push=push)
    toml = (
        '[psi.damping]\ntarget = "joint/pivot/damping"\nprior = { LogNormal = { loc = -3.0, scale = 0.7 } }\n'
        + noise_table(2e-3, 2e-2)
    )
    return pose(make_study(tmp_path_factory.mktemp("both") / "study", model_xml(PENDULUM), toml, made))


def test_the_pair_that_is_there_comes_first(study):
    base = fit(study)
    found = pairs(base, screen(base, [place(study, n, "pivot", TYPICAL) for n in NAMES]))
    names = {s.placed.effect.name for s in found[0].members}
    assert names == {"coulomb_friction", "quadratic_damping"}
    assert found[0].log_evidence > found[1].log_evidence + 10


def test_both_are_explained(study):
    found = explain(fit(study), [place(study, n, "pivot", TYPICAL) for n in NAMES], Looks())
    values = found.after.problem.constrained(found.after.point.z[None])
    assert len(found.after.problem.effects) == 2 and found.after.noise_inflation < 1.2
    assert float(values["coulomb_friction[pivot].force"][0]) == pytest.approx(0.02, rel=0.1)
    assert float(values["quadratic_damping[pivot].coefficient"][0]) == pytest.approx(0.01, rel=0.1)
