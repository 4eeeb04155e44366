"""Simulations that an observer leads: its gains, and the C engine that follows them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from catalogue import VALUES, place_form
from conftest import ARM, FREE, HINGE, MOTORS, blank_recording
from scipy import stats

from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.engines.mujoco_c import MujocoC
from det2stoc_bayes.engines.observer import Observer, Places, corrected, forgetting_gains
from det2stoc_bayes.segments import cut

SENSED = '<sensor><framepos name="tip" objtype="xbody" objname="stone"/></sensor>'


def test_gains_are_those_of_a_kalman_filter_that_forgets():
    """Against the textbook update with a matrix inverse, for uneven steps and dropped samples."""
    random = np.random.default_rng(0)
    time, seen = np.cumsum(random.uniform(0.01, 0.03, (2, 7)), 1), random.uniform(size=(2, 7, 3, 2)) < 0.7
    noise = np.array([[1e-3, 1e-2], [2e-3, 3e-2], [1e-3, np.inf]])
    seen[:, :, 2, 1] = False
    first, memory = np.array([[1e-3, 1e-2], [2e-3, 3e-2], [1e-3, 0.1]]), 8.0
    gains, spread = forgetting_gains(time, seen, noise, first, memory)
    for s in range(2):
        for v in range(3):
            p = np.diag(first[v] ** 2)
            for j in range(1, 7):
                step = np.array([[1, time[s, j] - time[s, j - 1]], [0, 1]])
                rows = np.flatnonzero(seen[s, j, v])
                p = step @ p @ step.T / (1 - 1 / memory if len(rows) else 1.0)
                h = np.eye(2)[rows]
                k = p @ h.T @ np.linalg.inv(h @ p @ h.T + np.diag(noise[v][rows] ** 2))
                expected = np.zeros((2, 2))
                expected[:, rows] = k
                np.testing.assert_allclose(gains[s, j, v], expected, atol=1e-12)
                for i in rows:
                    assert spread[s, j, v, i] == pytest.approx(np.sqrt(1 + p[i, i] / noise[v, i] ** 2))
                p = p - k @ h @ p


def followed(model, time, gains, values=None, effects=(), columns=None, count=1, drawn=False):
    """What the engine foretells of one recording, led by these gains."""
    segments = cut([blank_recording(model, time, columns)])
    shape = segments.values.shape
    random = np.random.default_rng(1)
    qpos = np.tile(model.qpos0, (count, 1))
    qvel = np.tile(random.standard_normal(model.nv), (count, 1))
    request = Request(segments, np.zeros(count, int), Start(qpos, qvel, np.zeros((count, model.na))), {}, effects)
    values = np.zeros(shape) if values is None else values
    observer = Observer(gains, values, np.ones((*shape[:2], model.nv, 2), bool), drawn)
    return request, MujocoC(model, 1).trajectory(replace(request, observer=observer))


@pytest.mark.parametrize("bodies", [HINGE, ARM, FREE])
@pytest.mark.parametrize("time", [np.arange(11) * 0.02, np.array([0.0, 0.013, 0.02, 0.0312, 0.05, 0.0501, 0.09])])
def test_without_gains_it_is_an_ordinary_simulation(compiled, bodies, time):
    model = compiled(bodies)
    gains = np.zeros((1, len(time), model.nv, 2, 2))
    request, led = followed(model, time, gains)
    plain = MujocoC(model, 1).trajectory(request)
    # between two steps of 2 ms on a straight line: 6e-4 rad/s at most here
    for name in ("columns", "qpos", "qvel"):
        np.testing.assert_allclose(getattr(led, name), getattr(plain, name), atol=1e-3, rtol=0)
    if time[1] == 0.02:
        np.testing.assert_allclose(led.columns, plain.columns, atol=1e-13)


@pytest.mark.parametrize("drawn", [False, True])
def test_recordings_are_led_alike_alone_and_beside_others_of_another_clock(compiled, drawn):
    """Every 20 ms, every 10 ms, with samples dropped, and at uneven times."""
    model, random = compiled(FREE), np.random.default_rng(3)
    clocks = [np.arange(16) * 0.02, np.arange(31) * 0.01, np.delete(np.arange(16) * 0.02, [4, 5])]
    clocks.append(np.cumsum(np.concatenate([[0.0], random.uniform(0.003, 0.03, 15)])))
    together = cut([blank_recording(model, time, None) for time in clocks])
    shape = (*together.values.shape[:2], model.nv, 2)
    gains = random.uniform(0.0, 0.3, (*shape, 2))
    observer = Observer(gains, 0.1 * random.standard_normal(together.values.shape), np.ones(shape, bool), drawn)
    speeds = random.standard_normal(model.nv)

    def led(which):
        count = len(which)
        start = Start(np.tile(model.qpos0, (count, 1)), np.tile(speeds, (count, 1)), np.zeros((count, model.na)))
        return MujocoC(model, 1).trajectory(Request(together, np.array(which), start, {}, (), observer=observer))

    every = led(range(4))
    for k in range(4):
        alone = led([k])
        for name in ("columns", "qpos", "qvel"):
            np.testing.assert_array_equal(getattr(every, name)[k], getattr(alone, name)[0])


def test_effects_with_and_without_a_step_of_their_own_act(compiled):
    model = compiled(ARM, rest=MOTORS, option='<option timestep="0.002" density="1.2" wind="1 0 0"/>')
    time = np.arange(11) * 0.02
    gains = np.zeros((1, 11, model.nv, 2, 2))
    for name in ("LinearDrag", "ViscousDamping"):
        effects = (EffectRows.alike(place_form(model, name), 1, VALUES[name]),)
        request, led = followed(model, time, gains, effects=effects)
        plain = MujocoC(model, 1).trajectory(request)
        np.testing.assert_allclose(led.columns, plain.columns, atol=1e-12)
        bare = MujocoC(model, 1).trajectory(replace(request, effects=()))
        assert np.abs(led.columns - bare.columns).max() > 1e-3


def test_full_gains_lead_to_the_recorded_state_and_the_next_sample_follows_from_it(compiled):
    model = compiled(FREE)
    time = np.arange(6) * 0.02
    random = np.random.default_rng(2)
    values = random.standard_normal((1, 6, 13))
    values[..., 3:7] /= np.linalg.norm(values[..., 3:7], axis=-1, keepdims=True)
    gains = np.tile(np.eye(2), (1, 6, 6, 1, 1))
    _, led = followed(model, time, gains, values)
    for j in range(1, 6):
        turn = led.qpos[0, j, 3:]
        np.testing.assert_allclose(led.qpos[0, j, :3], values[0, j, :3], atol=1e-12)
        np.testing.assert_allclose(abs(turn @ values[0, j, 3:7]), 1.0, atol=1e-12)
        np.testing.assert_allclose(led.qvel[0, j], values[0, j, 7:], atol=1e-12)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = led.qpos[0, 2], led.qvel[0, 2]
    mujoco.mj_step(model, data, 10)
    np.testing.assert_allclose(led.columns[0, 3], np.concatenate([data.qpos, data.qvel]), atol=1e-10)


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
def test_after_a_correction_a_force_is_that_of_the_corrected_state(compiled, integrator):
    model = compiled(FREE, option=f'<option timestep="0.002" density="1.2" integrator="{integrator}"/>')
    time, values = np.arange(6) * 0.02, 0.3 * np.random.default_rng(2).standard_normal((1, 6, 13))
    values[..., 3] += 1.0
    values[..., 3:7] /= np.linalg.norm(values[..., 3:7], axis=-1, keepdims=True)
    effects = (EffectRows.alike(place_form(model, "LinearDrag"), 1, VALUES["LinearDrag"]),)
    request, led = followed(model, time, np.tile(np.eye(2), (1, 6, 6, 1, 1)), values, effects)
    for j in range(1, 5):
        start = Start(led.qpos[:, j], led.qvel[:, j], np.zeros((1, model.na)))
        short = cut([blank_recording(model, time[j : j + 2] - time[j], None)])
        plain = MujocoC(model, 1).trajectory(replace(request, segments=short, start=start))
        # speeds "one step ago", by which RK4 foretells those in the middle of a step, are the corrected ones at a start
        np.testing.assert_allclose(
            led.columns[0, j + 1], plain.columns[0, 1], atol=1e-12 if integrator != "RK4" else 1e-4
        )


def test_a_sensor_of_the_state_is_read_before_the_correction(compiled):
    model = compiled(FREE, rest=SENSED)
    time = np.arange(6) * 0.02
    columns = [f"sensor/tip/{k}" for k in range(3)]
    gains = np.zeros((1, 6, model.nv, 2, 2))
    gains[..., 0, 0] = 0.5
    _, led = followed(model, time, gains, np.ones((1, 6, 3)), columns=columns)
    moved = led.qpos[0, 1:, :3] - led.columns[0, 1:]
    np.testing.assert_allclose(moved, 0.5 * (1.0 - led.columns[0, 1:]), atol=1e-10)


def test_innovations_of_a_right_model_are_white_and_as_wide_as_foretold(compiled):
    """A free mass: its log density as a product over innovations is that of all samples at once."""
    model = compiled(
        '<body><joint name="slide" type="slide"/><geom size="0.1" mass="1"/></body>', option='<option gravity="0 0 0"/>'
    )
    count, time = 400, np.arange(31) * 0.02
    random, sd = np.random.default_rng(3), np.array([1e-3, 2e-2])
    first = np.array([[1e-3, 0.2]])
    start = random.standard_normal((count, 2)) * first
    truth = np.stack([start[:, :1] + start[:, 1:] * time, np.tile(start[:, 1:], 31)], -1)
    values = truth + sd * random.standard_normal(truth.shape)
    seen = np.ones((1, 31, 1, 2), bool)
    gains, spread = forgetting_gains(time[None], seen, sd[None], first, np.inf)
    segments = cut([blank_recording(model, time)] * count)
    zero = Start(np.zeros((count, 1)), np.zeros((count, 1)), np.zeros((count, 0)))
    observer = Observer(np.tile(gains, (count, 1, 1, 1, 1)), values, np.tile(seen, (count, 1, 1, 1)))
    led = MujocoC(model, 1).trajectory(Request(segments, np.arange(count), zero, {}, observer=observer))
    e = ((values - led.columns) / (sd * spread[:, :, 0]))[:, 1:]
    position = e[..., 0]
    assert np.mean(position**2) == pytest.approx(1, abs=4 * np.sqrt(2 / position.size))
    assert abs(np.mean(position[:, 1:] * position[:, :-1])) < 4 / np.sqrt(position.size)
    basis = np.stack([np.ones(30), time[1:]])
    cov = (basis.T * first[0] ** 2) @ basis + sd[0] ** 2 * np.eye(30)
    alone = Observer(*_of_positions(time, sd, first, values, count))
    led = MujocoC(model, 1).trajectory(Request(segments, np.arange(count), zero, {}, observer=alone))
    wide = sd[0] * _spread_of_positions(time, sd, first)
    mine = stats.norm.logpdf(values[:, 1:, 0], led.columns[:, 1:, 0], wide).sum(1)
    np.testing.assert_allclose(mine, stats.multivariate_normal(np.zeros(30), cov).logpdf(values[:, 1:, 0]), rtol=1e-6)


def _seen_positions(time):
    seen = np.ones((1, len(time), 1, 2), bool)
    seen[..., 1] = False
    return seen


def _of_positions(time, sd, first, values, count):
    seen = _seen_positions(time)
    gains, _ = forgetting_gains(time[None], seen, sd[None], first, np.inf)
    return np.tile(gains, (count, 1, 1, 1, 1)), values, np.tile(seen, (count, 1, 1, 1))


def _spread_of_positions(time, sd, first):
    return forgetting_gains(time[None], _seen_positions(time), sd[None], first, np.inf)[1][0, 1:, 0, 0]


def test_drawn_innovations_are_followed(compiled):
    """Values are then errors of what is foretold: with these as recorded values the same path results."""
    model = compiled(FREE)
    time, random = np.arange(6) * 0.02, np.random.default_rng(4)
    noise = 1e-2 * random.standard_normal((1, 6, 13))
    gains = np.tile(0.3 * np.eye(2), (1, 6, 6, 1, 1))
    _, drawn = followed(model, time, gains, noise, drawn=True)
    _, again = followed(model, time, gains, drawn.columns + noise)
    np.testing.assert_allclose(again.columns[:, 1:], drawn.columns[:, 1:], atol=1e-12)


def test_places_tell_noise_and_errors_of_coordinates(compiled):
    model = compiled(FREE)
    columns = blank_recording(model, np.arange(2.0)).columns
    places = Places(model, columns)
    sd = np.arange(1.0, 14.0)
    noise = places.noise(sd)
    np.testing.assert_array_equal(noise[:3, 0], sd[:3])
    np.testing.assert_array_equal(noise[3:, 0], 2 * sd[3:7].mean())
    np.testing.assert_array_equal(noise[:, 1], sd[7:])
    predicted, recorded = np.zeros((1, 13)), np.full((1, 13), np.nan)
    predicted[0, 3] = 1.0
    assert (places.errors(predicted, recorded) == 0).all()
    recorded[0, 3:7] = -np.cos(0.1), 0.0, -np.sin(0.1), 0.0  # -q is the same turn, by 0.2 rad about y
    np.testing.assert_allclose(places.errors(predicted, recorded)[0, :, 0], [0, 0, 0, 0, 0.2, 0], atol=1e-12)
    moved, push = corrected(
        model, predicted[:, :7], np.tile(np.eye(2), (1, 6, 1, 1)), places.errors(predicted, recorded)
    )
    np.testing.assert_allclose(moved[0, 3:], [np.cos(0.1), 0, np.sin(0.1), 0], atol=1e-12)
    assert not push.any()
