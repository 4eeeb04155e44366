"""A diagnosis as arrays."""

import mujoco
import numpy as np
from conftest import ARM, MOTORS, blank_recording, model_xml

from det2stoc_bayes.mismatch.result import holding
from det2stoc_bayes.mismatch.where import Condition


def test_a_condition_on_a_command_holds_where_the_command_was_given():
    model = mujoco.MjModel.from_xml_string(model_xml(ARM, MOTORS))
    commands = np.array([[0.9, 0.0], [0.9, 0.3], [0.0, -0.8], [0.0, 0.9]])
    recording, names = blank_recording(model, np.arange(4) * 0.01, ctrl=commands), ["turn", "servo"]
    strong = Condition("abs(ctrl/servo) > 0.5", 0.9, "ctrl/servo", 0.5)
    unseen = Condition("abs(ctrl/push) > 0.5", 0.9, "ctrl/push", 0.5)
    np.testing.assert_array_equal(holding(recording, [unseen, strong], names), [False, False, True, True])
    assert holding(recording, [unseen], names) is None
