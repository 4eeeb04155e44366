"""Rotation vectors against MuJoCo's own."""

import mujoco
import numpy as np

from det2stoc_bayes.engines.rotations import relative_rotation, rotated


def test_they_are_mujocos_and_undo_each_other():
    random = np.random.default_rng(0)
    a, b = random.standard_normal((2, 50, 4))
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    found, expected = relative_rotation(a, b), np.zeros((50, 3))
    for row, first, second in zip(expected, a, b, strict=True):
        mujoco.mju_subQuat(row, second, first)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    again = rotated(a, found)
    np.testing.assert_allclose(np.abs((again * b).sum(1)), 1.0, atol=1e-12)
    np.testing.assert_array_equal(relative_rotation(a, a), 0.0)
    np.testing.assert_allclose(relative_rotation(a, -b), found, atol=1e-12)


def test_small_turns_keep_their_digits():
    still = np.array([[1.0, 0, 0, 0]])
    small = np.array([[1e-9, -2e-9, 3e-14]])
    np.testing.assert_allclose(relative_rotation(still, rotated(still, small)), small, rtol=1e-9, atol=1e-24)
