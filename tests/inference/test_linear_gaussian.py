"""The closed form of the linear Gaussian study is MuJoCo's motion."""

import mujoco
import numpy as np

from det2stoc_bayes.models import linear_gaussian


def test_recurrence_is_what_the_simulator_does():
    model = mujoco.MjModel.from_xml_path(str(linear_gaussian.MODEL))
    assert model.opt.timestep == linear_gaussian.TIMESTEP
    data = mujoco.MjData(model)
    gravity = np.array([0.7, -0.4])
    model.opt.gravity[[0, 2]] = gravity
    data.qpos[:], data.qvel[:] = (0.1, -0.2), (0.3, 0.5)
    mujoco.mj_step(model, data, 200)
    h, k = linear_gaussian.TIMESTEP, 200
    expected = np.array([0.1, -0.2]) + k * h * np.array([0.3, 0.5])
    expected += h**2 * k * (k + 1) / 2 * (linear_gaussian.AXES @ gravity)
    np.testing.assert_allclose(data.qpos, expected, atol=1e-10)


def test_posterior_narrows_with_the_data(gaussian_problem):
    _, covariance = linear_gaussian.exact_posterior(gaussian_problem)
    sd = np.sqrt(np.diag(covariance))
    assert (sd < 0.8 * np.array(linear_gaussian.Setting().prior_sd)).all()
    assert abs(covariance[0, 1]) > 0.3 * sd.prod()
