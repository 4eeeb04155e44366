"""What simulations in bulk do without."""

import mujoco
import pytest
from conftest import model_xml
from simulated import SPRING

from det2stoc_bayes.engines import quiet
from det2stoc_bayes.engines.quiet import UNTIMED

STEPS = int(mujoco.mjtTimer.mjTIMER_STEP)


def timed(model):
    """How much of a step's time MuJoCo's profiler counts."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=100)
    return data.timer[STEPS].duration


def test_no_clock_is_read_and_afterwards_it_is_again():
    model = mujoco.MjModel.from_xml_string(model_xml(SPRING))
    assert timed(model) > 0
    with UNTIMED:
        with UNTIMED:
            assert timed(model) == 0
        assert timed(model) == 0
    assert timed(model) > 0
    with pytest.raises(ValueError, match="inside"), UNTIMED:
        raise ValueError("inside")
    assert timed(model) > 0


def test_where_no_clock_is_read_already_none_is_put_back(monkeypatch):
    model, clock = mujoco.MjModel.from_xml_string(model_xml(SPRING)), quiet._clock()
    assert clock is not None
    before, clock.value = clock.value, None
    try:
        with UNTIMED:
            assert timed(model) == 0
        assert timed(model) == 0
    finally:
        clock.value = before
    monkeypatch.setattr(quiet, "_clock", lambda: None)  # where the library is not found
    with UNTIMED:
        assert timed(model) > 0
