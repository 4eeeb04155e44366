"""What of an effect shows in recordings with contact, whose beginnings are not known better than they are measured."""

import numpy as np
import pytest

from det2stoc_bayes.blind.laws import Effect
from det2stoc_bayes.blind.probe import draw_probe
from det2stoc_bayes.blind.short_sizing import LEAST, find_short, told
from det2stoc_bayes.blind.systems import SYSTEMS

PATCH = {"ratio": 2.0, "point": [0.08, 0.04, 0.015], "normal": [0.98, 0.199, 0.0]}


@pytest.fixture(scope="module")
def probe():
    system = SYSTEMS["puck"].measuring("qpos")
    psi = {"friction": 0.2, "turning": 0.003}
    return draw_probe(np.random.default_rng(0), system, psi, 0.01 * np.arange(system.samples)).first()


def test_a_drag_that_has_ended_before_the_recording_begins_does_not_show(probe):
    """It stops the puck within a tenth of a second: the rest is as another friction and start would make it."""
    size, change = told(probe, Effect("quadratic_drag", "body", "puck", {"coefficient": 5.4}))
    assert change > 1.0  # 3 noise sds from the same beginnings
    assert size < 0.2


def test_a_region_of_other_friction_shows(probe):
    size, change = told(probe, Effect("friction_patch", "contact", "disc/table", PATCH))
    assert LEAST < size < change


def test_what_diverges_is_not_told(probe):
    size, _ = told(probe, Effect("linear_drag", "body", "puck", {"coefficient": 1e5}))
    assert np.isnan(size)


def test_the_size_found_is_of_the_effect(probe):
    found = find_short(np.random.default_rng(3), probe, ("gravity_tilt", "world"))
    assert found is not None
    assert found.size == told(probe, found.effect)[0] >= LEAST
