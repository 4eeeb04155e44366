"""Measurement noise: what the study gives, and what the scatter between neighbours tells."""

from pathlib import Path

import numpy as np
import pytest

from det2stoc_bayes.noise import noise_sd
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import cut

COLUMNS = ("qpos/a", "qvel/a")
TIME = 0.01 * np.arange(1500)


def segments(values, num_samples=None):
    values = np.asarray(values, float)
    time = 0.01 * np.arange(len(values))
    return cut([Recording("a", time, COLUMNS, values, np.zeros((len(time), 0)), Path("a.csv"))], num_samples)


def noisy(sd, motion=0.0, seed=0):
    return motion + np.asarray(sd) * np.random.default_rng(seed).standard_normal((len(TIME), 2))


@pytest.mark.parametrize("num_samples", [None, 50])
def test_the_motion_does_not_count_as_noise(num_samples):
    motion = np.stack([3 * np.sin(4 * TIME), 12 * np.cos(4 * TIME)], 1)
    # Measured: 0.97 to 1.003 of the truth; the estimate's own sampling error is about 3 %.
    np.testing.assert_allclose(noise_sd(segments(noisy((2e-3, 5e-2), motion), num_samples), {}), (2e-3, 5e-2), rtol=0.1)


def test_what_is_given_is_taken():
    found = noise_sd(segments(noisy((2e-3, 5e-2))), {"qvel/a": 0.7})
    assert found[1] == 0.7 and found[0] == pytest.approx(2e-3, rel=0.1)


def test_a_few_sharp_turns_and_dropped_samples_do_not_matter():
    values = noisy((0.1, 0.1))
    values[::100, 0] += 50.0
    values[7::11, 1] = np.nan
    # Measured: 0.105 (a twenty-fifth of the differences holds a jump) and 0.097.
    np.testing.assert_allclose(noise_sd(segments(values), {}), (0.1, 0.1), rtol=0.15)


def test_a_column_without_noise_keeps_a_floor():
    found = noise_sd(segments(np.stack([np.full(1500, 4.0), np.zeros(1500)], 1)), {})
    assert found[0] == pytest.approx(4e-6) and 0 < found[1] < 1e-9


def test_too_few_samples_fall_back_on_the_spread():
    values = np.array([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0], [3.0, 1.0]])
    found = noise_sd(segments(values), {})
    assert found[0] == pytest.approx(np.std([0, 1, 2, 3])) and found[1] > 0


@pytest.mark.parametrize("turn", [0.04, 0.3, 0.8])  # rad of the motion between samples
@pytest.mark.parametrize("length", [100, 300, 1500])
def test_coarsely_sampled_motion_does_not_count_as_noise(turn, length):
    random = np.random.default_rng(0)
    found = []
    for _ in range(10):
        motion = np.sin(turn * (np.arange(length) + random.uniform(0, 10)))
        found.append(noise_sd(segments(motion[:, None] + 1e-3 * random.standard_normal((length, 2))), {})[0])
    # Measured: 0.99 to 1.04 on average; third differences alone gave 1.0, 6 and 110.
    assert np.mean(found) == pytest.approx(1e-3, rel=0.15)


def test_stiff_motion_counts_little():
    i = np.arange(1500)
    motion = np.sin(0.05 * i) + 0.2 * np.sin(1.2 * i) * np.exp(-i / 60)
    found = noise_sd(segments(motion[:, None] + 1e-3 * np.random.default_rng(0).standard_normal((1500, 2))), {})
    # Measured: 1.03 of the noise.
    assert found[0] == pytest.approx(1e-3, rel=0.15)


@pytest.mark.parametrize("turn", [0.0, 0.04, 0.4])
def test_never_below_the_rounding_of_an_encoder(turn):
    true = 0.3 + np.sin(turn * np.arange(1000))[:, None] + 1e-6 * np.random.default_rng(0).standard_normal((1000, 2))
    rounded = np.round(true / 1e-3) * 1e-3
    found = noise_sd(segments(rounded), {})[0]
    # Measured: 1.00 of step / sqrt(12), also where the motion crosses hundreds of steps a sample; at rest the floor.
    assert found == pytest.approx(1e-3 / np.sqrt(12) if turn else 1e-6, rel=0.1, abs=1e-6)


def test_uneven_times_and_dropped_samples():
    random = np.random.default_rng(0)
    time = np.sort(random.uniform(0, 10, 1000))
    values = np.sin(3 * time)[:, None] + 1e-3 * random.standard_normal((1000, 2))
    values[random.random((1000, 2)) < 0.3] = np.nan
    record = Recording("a", time, COLUMNS, values, np.zeros((1000, 0)), Path("a.csv"))
    # Measured: 1.06.
    np.testing.assert_allclose(noise_sd(cut([record]), {}), 1e-3, rtol=0.15)
