"""Fits where the state is recorded only in part, or through sensors alone."""

import numpy as np
import pytest
from conftest import FREE, make_study, model_xml
from simulated import noise_table, pose, recordings

from det2stoc_bayes.map import find_map

INERTIA = """
[psi.inertia]
target = "body/stone/inertia"
index = [2]
prior = { LogNormal = { loc = -5.5, scale = 0.5 } }
"""
PLACE = [f"qpos/float/{c}" for c in ("x", "y", "z", "qw", "qx", "qy", "qz")]


def test_a_tumbling_body_is_fitted_from_its_positions_alone(tmp_path):
    spins = ([5, -3, 2], [30, 4, -20], [0.1, -15, 0.3])
    starts = [([0, 0, 2, 1, 0, 0, 0], [0.3, 0, 1, *spin]) for spin in spins]
    noise = [1e-3] * 3 + [1e-4] * 4 + [0] * 6
    made = recordings(model_xml(FREE), starts, 5 * np.arange(80), noise, columns=PLACE)
    toml = INERTIA + noise_table(1e-3) + '"qpos/float/q?" = 1e-4\n'
    fit = find_map(pose(make_study(tmp_path / "stone", model_xml(FREE), toml, made)))
    # Measured: 0.83 of the noise (a unit quaternion has one number less than its columns).
    assert 0.7 < fit.noise_inflation < 1.1
    (found,), sd = fit.problem.psi(fit.point.z), 0.5 * float(np.sqrt(fit.covariance[0, 0])) * 0.0036
    assert found == pytest.approx(0.8 / 3 * (0.1**2 + 0.06**2), abs=4 * sd)
