"""What simulations in bulk do without."""

import mujoco
import pytest
from conftest import model_xml
from simulated import SPRING

from det2stoc_bayes.engines.quiet import QUIET

STEPS = int(mujoco.mjtTimer.mjTIMER_STEP)


def timed(model):
    """How much of a step's time MuJoCo's profiler counts."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=100)
    return data.timer[STEPS].duration


def test_no_clock_is_read_and_afterwards_it_is_again():
    model = mujoco.MjModel.from_xml_string(model_xml(SPRING))
    assert timed(model) > 0
    with QUIET:
        with QUIET:
            assert timed(model) == 0
        assert timed(model) == 0
    assert timed(model) > 0
    with pytest.raises(ValueError, match="inside"), QUIET:
        raise ValueError("inside")
    assert timed(model) > 0
