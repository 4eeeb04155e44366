"""Angles that a recorder wrapped."""

import numpy as np
import pytest

from det2stoc_bayes.recording_angles import unwrap

TIME = np.arange(300) * 0.02


@pytest.mark.parametrize("low", [-np.pi, 0.0])
@pytest.mark.parametrize("speed", [0.3, 4.0, -30.0, 50.0])
def test_a_turning_hinge_is_unwrapped(low, speed):
    true = 1.0 + speed * TIME + 0.1 * np.sin(9 * TIME) + 1e-3 * np.random.default_rng(0).standard_normal(300)
    recorded = (true - low) % (2 * np.pi) + low
    recorded[::7] = np.nan
    found, jumps = unwrap(recorded)
    seen = np.isfinite(recorded)
    assert np.ptp((found - true)[seen]) < 1e-9
    assert jumps == pytest.approx(abs(speed) * 6 / (2 * np.pi), abs=2)


def test_noise_at_the_seam_is_unwrapped():
    true = np.pi + 0.01 * np.random.default_rng(0).standard_normal(300)
    recorded = (true + np.pi) % (2 * np.pi) - np.pi
    found, jumps = unwrap(recorded)
    assert np.ptp(found) < 0.1 and jumps > 100


@pytest.mark.parametrize(
    "motion",
    [3.0 * np.sin(2 * TIME), 3.1 * np.sign(np.sin(2 * TIME)) + 0.01 * np.sin(9 * TIME), 8 * TIME, 0 * TIME,
     np.where(TIME > 3, 2.5, -1.5) + 1e-3 * TIME],
    ids=["swing", "square", "already unwrapped", "rest", "step"],
)  # fmt: skip
def test_what_is_not_wrapped_stays(motion):
    found, jumps = unwrap(motion)
    np.testing.assert_array_equal(found, motion)
    assert jumps == 0


def test_few_values_stay():
    values = np.array([np.nan, 3.1, -3.1, np.nan])
    np.testing.assert_array_equal(unwrap(values)[0], values)
