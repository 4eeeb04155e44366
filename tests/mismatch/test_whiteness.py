"""Whether innovations are white, as a test whose level and power are known."""

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import SPRING, SPRING_PSI, fit, pose, recordings

from det2stoc_bayes.mismatch.whiteness import of_residuals, whiteness


def draws(correlation, size, seed, missing=0.0):
    """First-order autoregressive residuals (segments, samples, columns)."""
    random = np.random.default_rng(seed)
    r = random.standard_normal(size)
    for k in range(1, size[1]):
        r[:, k] = correlation * r[:, k - 1] + np.sqrt(1 - correlation**2) * r[:, k]
    r[random.random(size) < missing] = np.nan
    return r


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_white_noise_is_rejected_as_often_as_said(missing):
    p = np.array([of_residuals(("a", "b"), draws(0.0, (4, 100, 2), k, missing)).p_values for k in range(400)]).ravel()
    # Measured: 0.043 and 0.066 below 0.05, 0.50 on average; standard errors 0.008 and 0.010.
    assert (p < 0.05).mean() == pytest.approx(0.05, abs=0.03)
    assert p.mean() == pytest.approx(0.5, abs=0.05)


def test_persistence_is_found_in_its_column():
    r = draws(0.0, (4, 100, 2), 0)
    r[:, :, 1:] = draws(0.3, (4, 100, 1), 2)
    found = of_residuals(("a", "b"), r)
    assert found.worst == "b" and found.p_value < 1e-4
    assert found.p_values[0] > 0.01
    # The standard error of one lag of 400 samples is 0.05.
    assert found.correlation[1, 0] == pytest.approx(0.3, abs=0.15)


def test_nothing_recorded_says_nothing():
    r = np.full((2, 50, 1), np.nan)
    r[0, :5] = 1.0
    assert of_residuals(("a",), r).p_value == 1.0


def swings(folder, seed, noise=0.01, **options):
    starts = [([0.3], [0.0]), ([-0.2], [1.0]), ([0.1], [-1.5])]
    made = recordings(model_xml(SPRING), starts, 10 * np.arange(120), (noise, 10 * noise), seed=seed, **options)
    return fit(pose(make_study(folder / f"spring_{seed}", model_xml(SPRING), SPRING_PSI, made)))


def test_a_fit_of_the_right_model_leaves_white_noise_of_unknown_size(tmp_path):
    p = [whiteness(swings(tmp_path, seed)).p_value for seed in range(30)]
    # Measured: 3 of 30 below 0.05, 0.51 in the middle.
    assert np.mean(np.array(p) < 0.05) < 0.17
    assert np.median(p) > 0.25


@pytest.mark.parametrize("coefficient", [1.0, 2.0])
def test_what_a_model_leaves_out_is_not_white(tmp_path, coefficient):
    def drag(model, data):
        data.qfrc_applied[0] = -coefficient * abs(data.qvel[0]) * data.qvel[0]

    found = whiteness(swings(tmp_path, 0, push=drag))
    # Measured: 4e-6 and 5e-35, while the error is 6 % and 30 % of the noise variance.
    assert found.p_value < (1e-3 if coefficient < 2 else 1e-20)
