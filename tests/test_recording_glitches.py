"""Single samples that stand alone, and everything that only looks so."""

import mujoco
import numpy as np
import pytest

from det2stoc_bayes.recording_glitches import glitches, resolution

TIME = np.arange(400) * 0.01
SWING = np.sin(5 * TIME)


def noise(sd, seed=0, size=400):
    return sd * np.random.default_rng(seed).standard_normal(size)


@pytest.mark.parametrize("size", [0.2, -0.5, 1e3])
@pytest.mark.parametrize("uneven", [False, True])
def test_glitches_are_found_and_nothing_else(size, uneven):
    time = np.sort(np.random.default_rng(5).uniform(0, 4, 400)) if uneven else TIME
    values = np.sin(5 * time) + noise(1e-3)
    values[[50, 200, 390]] += size
    values[51:390:11] = np.nan
    # Measured: uneven samples, some of them 1e-5 s apart, hide none of these.
    assert set(np.flatnonzero(glitches(time, values))) == {50, 200, 390}


def test_glitches_beside_each_other_are_not_alone():
    values = SWING + noise(1e-3)
    values[100:103] += 0.5
    assert not glitches(TIME, values).any()


def test_white_noise_has_none():
    random = np.random.default_rng(1)
    # Measured: 0 of 200 000; heavy tails (4 degrees of freedom) 0.008 %, each beyond 8 sds of the noise.
    assert sum(glitches(TIME, random.standard_normal(400)).sum() for _ in range(500)) == 0
    heavy = sum(glitches(TIME, random.standard_t(4, 400)).sum() for _ in range(500))
    assert heavy < 1e-3 * 200_000


@pytest.mark.parametrize("scale", [0.0, 1e-4])
@pytest.mark.parametrize("stride", [1, 5, 17])
def test_bouncing_has_none(scale, stride):
    xml = """<mujoco><option timestep="0.001"/><worldbody><geom type="plane" size="1 1 1"/>
      <body pos="0 0 1"><joint name="z" type="slide" axis="0 0 1"/><geom size="0.05" mass="0.1"/></body></worldbody>
      </mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.o_solref[:], model.geom_solref[:] = (-2e4, -1), (-2e4, -1)
    data, rows = mujoco.MjData(model), []
    for _ in range(6000):
        rows.append((data.qpos[0], data.qvel[0]))
        mujoco.mj_step(model, data)
    values = np.array(rows)[::stride]
    assert (np.diff(np.sign(values[:, 1])) > 0).sum() > 3  # it does bounce
    time = 0.001 * stride * np.arange(len(values))
    for column, sd in zip(values.T, (scale, 100 * scale), strict=True):
        assert not glitches(time, column + noise(sd, size=len(column))).any()


@pytest.mark.parametrize("step", [1e-3, 0.05])
@pytest.mark.parametrize("speed", [0.02, 1.0, 5.0])
def test_a_quantised_encoder_has_none(step, speed):
    for phase in range(20):
        values = np.round((np.sin(speed * TIME + phase) + noise(1e-4, phase)) / step) * step
        assert not glitches(TIME, values).any()


def test_jumps_kinks_and_stops_are_none():
    for at in np.linspace(1.5, 1.51, 11):
        late = np.maximum(TIME - at, 0)
        for motion in (at < TIME, late, -3 * late + TIME, np.minimum(TIME, at), np.abs(TIME - at), late**2):
            assert not glitches(TIME, 1.0 * motion).any()
            assert not glitches(TIME, motion + noise(1e-4)).any()


def test_few_samples_are_not_judged():
    values = np.zeros(15)
    values[7] = 5.0
    assert not glitches(TIME[:15], values).any()


def test_the_resolution_of_an_encoder():
    assert resolution(np.round(SWING / 0.01) * 0.01) == pytest.approx(0.01 / np.sqrt(12))
    assert resolution(np.ones(9)) == 0
