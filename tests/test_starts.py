"""First guesses of initial states."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import CARTPOLE, FREE, model_xml, state_columns

from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import cut
from det2stoc_bayes.starts import guess_starts

TIME = np.concatenate([[0.0], np.cumsum(np.tile([0.01, 0.015, 0.02], 20))])


def guess(xml, columns, values, num_samples=None):
    model = mujoco.MjModel.from_xml_string(xml)
    record = Recording("a", TIME, tuple(columns), values, np.zeros((len(TIME), 0)), Path("a.csv"))
    return guess_starts(model, cut([record], num_samples))


def motion(t):
    """Rail and pivot, with their speeds."""
    return np.stack([0.5 * np.sin(3 * t), np.cos(2 * t), 1.5 * np.cos(3 * t), -2 * np.sin(2 * t)], -1)


COLUMNS = ("qpos/rail", "qpos/pivot", "qvel/rail", "qvel/pivot")


def test_velocities_come_from_the_slopes_of_positions():
    found = guess(model_xml(CARTPOLE), COLUMNS[:2], motion(TIME)[:, :2], 20)
    starts = TIME[[0, 20, 41]]
    np.testing.assert_allclose(found.start.qpos, motion(starts)[:, :2], atol=1e-12)
    # Measured: 0.016, of a speed of 1.5: a quadratic through nine samples of a sine.
    np.testing.assert_allclose(found.start.qvel, motion(starts)[:, 2:], atol=0.03)


def test_recorded_velocities_are_taken_as_they_are():
    found = guess(model_xml(CARTPOLE), COLUMNS, motion(TIME))
    np.testing.assert_allclose(found.start.qvel[0], motion(TIME)[0, 2:], atol=1e-12)


def test_an_empty_first_cell_is_extrapolated():
    values = motion(TIME)
    values[:2, 0], values[0, 3] = np.nan, np.nan
    found = guess(model_xml(CARTPOLE), COLUMNS, values)
    # Measured: 9e-4 and 5e-4.
    assert found.start.qpos[0, 0] == pytest.approx(0.0, abs=2e-3)
    assert found.start.qvel[0, 1] == pytest.approx(0.0, abs=2e-3)


def test_the_prior_is_three_times_as_wide_as_the_motion():
    values = motion(TIME)
    full, alone = guess(model_xml(CARTPOLE), COLUMNS, values), guess(model_xml(CARTPOLE), COLUMNS[:2], values[:, :2])
    np.testing.assert_allclose(full.scale, values.std(0), rtol=1e-9)
    np.testing.assert_allclose(alone.scale[:2], values.std(0)[:2], rtol=1e-9)
    # Measured: within 1.5 %: without velocities, the spread of the slopes.
    np.testing.assert_allclose(alone.scale[2:], values.std(0)[2:], rtol=0.03)
    np.testing.assert_allclose(full.prior_sd, 3 * full.scale[None])


def test_a_joint_that_was_not_recorded_starts_at_rest_where_the_model_does():
    found = guess(model_xml(CARTPOLE), COLUMNS[1:2], motion(TIME)[:, 1:2])
    assert found.start.qpos[0, 0] == 0 and found.start.qvel[0, 0] == 0
    assert found.start.qpos[0, 1] == 1.0


def test_quaternions_are_unit_ones():
    columns = state_columns(mujoco.MjModel.from_xml_string(model_xml(FREE)))
    values = np.zeros((len(TIME), 13))
    values[:, :7] = [1, 2, 3, 0.7, 0.1, 0.5, 0.2]
    found = guess(model_xml(FREE), columns, values)
    quaternion = found.start.qpos[0, 3:]
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    np.testing.assert_allclose(quaternion / quaternion[0], np.array([0.7, 0.1, 0.5, 0.2]) / 0.7)
    assert np.isfinite(found.prior_sd).all() and (found.prior_sd > 0).all()
    missing = guess(model_xml(FREE), columns[:3], values[:, :3])
    np.testing.assert_array_equal(missing.start.qpos[0, 3:], [1, 0, 0, 0])
