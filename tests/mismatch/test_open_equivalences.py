"""What recordings could not tell apart, known before anything is fitted."""

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import MOTOR, SLED, fit, noise_table, pose, recordings, spring_problem

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.open_equivalences import open_equivalences


def labels(group):
    return [p.label for p in group]


def test_psi_takes_up_what_it_sets_and_one_force_by_two_names_stays_open(tmp_path):
    bare = fit(spring_problem(tmp_path, noise=1e-3))
    found = open_equivalences(bare, candidates(bare.problem))
    hidden = labels(found.absorbed)
    assert {"viscous_damping on joint slide", "armature on joint slide"} <= set(hidden)  # of k, c and m two are free
    # A motion that hardly decays tells no law of drag from damping.
    assert {"linear_drag on body block", "quadratic_damping on joint slide"} <= set(hidden)
    groups = [labels(g) for g in found.groups]
    assert any({"constant_force on joint slide", "sensor_bias on sensor qpos/slide"} <= set(g) for g in groups)
    told = {label for g in groups for label in g} | set(hidden)
    assert not {"coulomb_friction on joint slide", "cubic_stiffness on joint slide"} & told


@pytest.mark.parametrize("held", [True, False])
def test_a_force_that_always_acts_is_a_bias_of_the_command(tmp_path, held):
    """Without a command that moves, a gain is a bias, too."""
    commands = [np.full((60, 1), 0.4) if held else np.sin(np.linspace(0, 9, 60))[:, None] for _ in range(2)]
    xml = model_xml(SLED, MOTOR)
    made = recordings(xml, [([0.0], [0.0]), ([0.1], [0.5])], 10 * np.arange(60), (1e-3, 1e-2), ctrl=commands)
    bare = fit(pose(make_study(tmp_path / "study", xml, noise_table(1e-3, 1e-2), made)))
    found = open_equivalences(bare, candidates(bare.problem))
    group = next(set(labels(g)) for g in found.groups if "constant_force on joint run" in labels(g))
    assert "actuator_bias on actuator push" in group
    assert ("actuator_gain on actuator push" in group) == held
    assert found.absorbed == ()
