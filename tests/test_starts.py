"""First guesses of initial states."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import CARTPOLE, FREE, model_xml, state_columns

from det2stoc_bayes.engines.rotations import rotated
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
    starts = TIME[[0, 15, 30, 46]]
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


def spinning(num_samples, rate=(3.0, -20.0, 7.0)):
    """A free body that turns at a constant rate about its own axes and falls; its orientation alone is recorded."""
    quaternion = rotated(np.array([0.5, 0.5, -0.5, 0.5]), TIME[:, None] * np.array(rate))
    place = np.stack([TIME, 2 * TIME, 1 - 4.9 * TIME**2], -1)
    names = [c for c in state_columns(mujoco.MjModel.from_xml_string(model_xml(FREE))) if c.startswith("qpos")]
    return guess(model_xml(FREE), names, np.concatenate([place, quaternion], 1), num_samples)


@pytest.mark.parametrize("num_samples", [None, 10])
def test_angular_velocity_comes_from_the_turns_between_samples(num_samples):
    found = spinning(num_samples)
    np.testing.assert_allclose(found.start.qvel[:, 3:], np.tile([3.0, -20.0, 7.0], (len(found.start.qvel), 1)))
    np.testing.assert_allclose(found.start.qvel[:, :2], np.tile([1.0, 2.0], (len(found.start.qvel), 1)))
    assert found.seen.all() and (found.prior_sd > 0).all()


def test_turning_is_found_in_the_frame_of_the_body():
    model = mujoco.MjModel.from_xml_string(model_xml(FREE))
    data, rows = mujoco.MjData(model), []
    data.qpos[3:7], data.qvel[:] = [0.6, 0.0, 0.8, 0.0], [0.5, 0, 2, 4.0, -6.0, 9.0]
    steps = np.rint(TIME / model.opt.timestep).astype(int)
    for k in range(steps[-1] + 1):
        if k in steps:
            rows.append(data.qpos.copy())
        mujoco.mj_step(model, data)
    columns = [c for c in state_columns(model) if c.startswith("qpos")]
    found = guess(model_xml(FREE), columns, np.array(rows))
    # Measured: 0.19 rad/s of 11.5 (tumbling bends the line through the turns), 0.02 m/s.
    np.testing.assert_allclose(found.start.qvel[0], [0.5, 0, 2, 4.0, -6.0, 9.0], atol=0.3)
    wide = np.abs(found.start.qvel[0] - [0.5, 0, 2, 4.0, -6.0, 9.0]) / found.prior_sd[0, 6:]
    assert (wide < 1).all()


def test_an_orientation_that_was_dropped_first_is_turned_back():
    whole = spinning(None)
    columns = [c for c in state_columns(mujoco.MjModel.from_xml_string(model_xml(FREE))) if c.startswith("qpos")]
    turned = rotated(np.array([0.5, 0.5, -0.5, 0.5]), TIME[:, None] * np.array([3.0, -20.0, 7.0]))
    values = np.concatenate([np.zeros((len(TIME), 3)), turned], 1)
    values[0, 3:] = np.nan
    found = guess(model_xml(FREE), columns, values)
    same = np.abs((found.start.qpos[0, 3:] * whole.start.qpos[0, 3:]).sum())
    assert same == pytest.approx(1.0, abs=1e-9)
