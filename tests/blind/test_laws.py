"""Each concealed law against an analytic check of its sign and its unit."""

import numpy as np
import pytest

from det2stoc_bayes.blind.laws import INTEGRATION, LAWS, Effect
from det2stoc_bayes.blind.probe import draw_probe
from det2stoc_bayes.blind.reality import PREROLL, simulate_believed, simulate_reality
from det2stoc_bayes.blind.systems import SYSTEMS, System

MASS, GRAVITY = 2.0, 9.81
TIMES = 0.01 * np.arange(201)
SINCE = TIMES + PREROLL  # simulations start before the first sample
FREE = """<worldbody><body name="block"><joint name="x" type="slide" axis="1 0 0"/>
<geom type="sphere" size="0.1" mass="2"/></body></worldbody>
<actuator><motor name="push" joint="x"/></actuator>"""
SERVO = FREE.replace("<motor", '<position kp="40" kv="5"')
SPINNER = """<worldbody><body name="bar"><joint name="turn" type="hinge" axis="0 0 1"/>
<inertial pos="0.5 0 0" mass="2" diaginertia="0.01 0.01 0.01"/></body></worldbody>"""
SWING = SPINNER.replace("0 0 1", "0 1 0")
FLYING = """<worldbody><body name="block"><freejoint name="fly"/>
<geom type="sphere" size="0.1" mass="2"/></body></worldbody>"""


def bare(xml: str, medium: str = "") -> System:
    """A system of this MJCF alone."""
    given = {"start_position": (), "start_velocity": (), "reach": (), "noise_sd": {"*": 1.0}}
    return System(name="bare", title="bare", body_xml=xml, psi=(), sampling=(0.01,), medium=medium, **given)


def effect_on(name: str, element: str, **parameters) -> Effect:
    return Effect(name, LAWS[name].kind, element, parameters)


def recorded(
    xml: str, effects, start, push: np.ndarray | float | None = None, medium: str = "", **options
) -> np.ndarray:
    """Columns of effects on a mechanism, from a state PREROLL before the first sample, under a command."""
    shape = (TIMES.size, 0 if push is None else 1)
    commands = np.broadcast_to(np.reshape(0.0 if push is None else push, (-1, 1)), shape).copy()
    effects = effects if isinstance(effects, tuple) else (effects,)
    return simulate_reality(bare(xml, medium), {}, effects, np.array(start, float), TIMES, commands, **options).columns


def run(effect: Effect, start: tuple[float, float], push: np.ndarray | float = 0.0) -> np.ndarray:
    return recorded(FREE, effect, start, push)


def joint_effect(name: str, **parameters: float) -> Effect:
    return effect_on(name, "x", **parameters)


def test_viscous_damping_decays_exponentially():
    speed = run(joint_effect("viscous_damping", coefficient=1.5), (0.0, 2.0))[:, 1]
    np.testing.assert_allclose(speed, 2.0 * np.exp(-1.5 * SINCE / MASS), rtol=1e-8)


def test_quadratic_damping_opposes_both_directions():
    for sign in (1.0, -1.0):
        speed = run(joint_effect("quadratic_damping", coefficient=0.8), (0.0, sign * 3.0))[:, 1]
        np.testing.assert_allclose(speed, sign * 3.0 / (1.0 + 0.8 * 3.0 * SINCE / MASS), rtol=1e-8)


def test_coulomb_friction_decelerates_evenly_and_holds():
    columns = run(joint_effect("coulomb_friction", force=3.0), (0.0, 1.5))
    moving = SINCE < 0.9 * 1.5 * MASS / 3.0
    np.testing.assert_allclose(columns[moving, 1], 1.5 - 3.0 / MASS * SINCE[moving], atol=5e-3)
    held = run(joint_effect("coulomb_friction", force=3.0), (0.0, 0.0), 2.0)
    assert np.abs(held[:, 1]).max() < 0.05  # MuJoCo's frictionloss creeps
    slipping = run(joint_effect("coulomb_friction", force=3.0), (0.0, 0.0), 5.0)
    assert slipping[-1, 1] == pytest.approx((5.0 - 3.0) / MASS * SINCE[-1], rel=0.02)


def test_stribeck_friction_holds_more_than_it_slows():
    stribeck = joint_effect("stribeck_friction", coulomb=2.0, static=5.0, velocity=0.05)
    assert np.abs(run(stribeck, (0.0, 0.0), 4.0)[:, 1]).max() < 0.05
    fast = run(stribeck, (0.0, 4.0))  # far above the velocity only the Coulomb part is left
    np.testing.assert_allclose(fast[:, 1], 4.0 - 2.0 / MASS * SINCE, atol=5e-3)


def test_load_dependent_friction_grows_with_the_motor():
    effect = joint_effect("load_dependent_friction", coefficient=0.3)
    for push in (5.0, -5.0):
        speed = run(effect, (0.0, np.sign(push) * 0.5), push)[:, 1]
        np.testing.assert_allclose(speed, np.sign(push) * 0.5 + 0.7 * push / MASS * SINCE, rtol=5e-3)
    np.testing.assert_allclose(run(effect, (0.0, 1.0))[:, 1], 1.0, rtol=1e-6)


def test_springs_oscillate_about_rest():
    rest = 0.4
    columns = run(joint_effect("joint_spring", stiffness=50.0, rest=rest), (0.7, 0.0))
    np.testing.assert_allclose(columns[:, 0], rest + 0.3 * np.cos(5.0 * SINCE), atol=1e-6)
    cubic = run(joint_effect("cubic_stiffness", stiffness=40.0), (0.5, 0.0))
    energy = 0.5 * MASS * cubic[:, 1] ** 2 + 0.25 * 40.0 * cubic[:, 0] ** 4
    np.testing.assert_allclose(energy, 0.25 * 40.0 * 0.5**4, rtol=1e-6)
    assert cubic[5, 1] < 0.0


def test_constant_force_and_armature():
    pushed = run(joint_effect("constant_force", force=-1.2), (0.0, 0.0))
    np.testing.assert_allclose(pushed[:, 0], -0.5 * 1.2 / MASS * SINCE**2, atol=1e-9)
    heavier = run(joint_effect("armature", inertia=3.0), (0.0, 0.0), 2.0)
    np.testing.assert_allclose(heavier[:, 1], 2.0 / (MASS + 3.0) * SINCE, atol=1e-9)


def test_cogging_is_a_sine_of_position_with_phase():
    columns = run(joint_effect("cogging_torque", amplitude=0.3, cycles=10.0, phase=0.5), (0.2, 0.1))
    energy = 0.5 * MASS * columns[:, 1] ** 2 + 0.03 * np.cos(10.0 * columns[:, 0] + 0.5)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)


def test_a_periodic_force_is_a_sine_of_recorded_time():
    rate = 2.0 * np.pi * 1.5
    speed = run(joint_effect("periodic_force", amplitude=0.7, frequency=1.5, phase=0.4), (0.0, 0.0))[:, 1]
    expected = 0.7 / MASS / rate * (np.cos(-rate * PREROLL + 0.4) - np.cos(rate * TIMES + 0.4))
    np.testing.assert_allclose(speed, expected, atol=1e-8)


def test_drags_act_on_the_centre_of_mass():
    inertia = 0.01 + MASS * 0.5**2
    quadratic = recorded(SPINNER, effect_on("quadratic_drag", "bar", coefficient=0.4), (0.0, 2.0))[:, 1]
    np.testing.assert_allclose(quadratic, 2.0 / (1.0 + 0.4 * 0.5**3 * 2.0 * SINCE / inertia), rtol=1e-6)
    linear = recorded(SPINNER, effect_on("linear_drag", "bar", coefficient=0.4), (0.0, 2.0))[:, 1]
    np.testing.assert_allclose(linear, 2.0 * np.exp(-0.4 * 0.5**2 * SINCE / inertia), rtol=1e-6)


def test_lift_is_spin_times_velocity():
    start = (0, 0, 0, 1, 0, 0, 0, 1.0, 0, 0, 0, 0, 3.0)  # moves to +x, turns about +z: pushed to +y
    speed = recorded(FLYING, effect_on("magnus_lift", "block", coefficient=0.2), start)[:, 7:9]
    angle = 0.2 * 3.0 / MASS * SINCE
    np.testing.assert_allclose(speed, np.column_stack((np.cos(angle), np.sin(angle))), atol=1e-7)


def first_acceleration(*effects: Effect, medium: str = "") -> float:
    """Angular acceleration of the bar let go at rest, horizontal; gravity turns it about +y."""
    return recorded(SWING, effects, (0.0, 0.0), medium=medium)[0, 1] / PREROLL


def hanging(mass: float, arm: float, inertia: float) -> float:
    return mass * GRAVITY * arm / (inertia + mass * arm**2)


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (effect_on("payload_mass", "bar", mass=0.5, offset=[0.8, 0.0, 0.0]), 9.81 * 1.4 / (0.51 + 0.5 * 0.64)),
        (effect_on("mass_error", "bar", mass=0.5), hanging(2.5, 0.5, 0.0125)),
        (effect_on("com_offset", "bar", offset=[0.1, 0.0, 0.0]), hanging(2.0, 0.6, 0.01)),
        (effect_on("inertia_error", "bar", ratio=[1.0, 3.0, 1.0]), hanging(2.0, 0.5, 0.03)),
        (effect_on("gravity_error", "world", change=1.0), hanging(2.0, 0.5, 0.01) * 8.81 / 9.81),
    ],
)
def test_mass_and_gravity_of_a_falling_bar(effect, expected):
    # Measured: the fall lowers the mean over PREROLL by up to 0.2 %.
    assert first_acceleration(effect) == pytest.approx(expected, rel=3e-3)


def test_a_payload_makes_the_same_body_as_two_geoms():
    two = SPINNER.replace("</body>", '<geom type="sphere" size="1e-4" mass="0.7" pos="0.1 0.2 0.3"/></body>').replace(
        '<inertial pos="0.5 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>', '<geom size="0.1" pos="0.5 0 0" mass="2"/>'
    )
    one = two.replace('<geom type="sphere" size="1e-4" mass="0.7" pos="0.1 0.2 0.3"/>', "")
    model, whole = bare(one).compile({}), bare(two).compile({})
    LAWS["payload_mass"].prepare(model, "bar", {"mass": 0.7, "offset": [0.1, 0.2, 0.3]})
    np.testing.assert_allclose(model.body_mass, whole.body_mass)
    np.testing.assert_allclose(model.body_ipos, whole.body_ipos, atol=1e-12)
    np.testing.assert_allclose(np.sort(model.body_inertia[1]), np.sort(whole.body_inertia[1]), rtol=1e-6)


def test_gravity_leans_towards_plus():
    start = (0, 0, 0, 1, *([0] * 9))
    speed = recorded(FLYING, effect_on("gravity_tilt", "world", toward_x=0.1, toward_y=-0.2), start)[-1, 7:10]
    x, y = np.sin(0.1), -np.sin(0.2)
    np.testing.assert_allclose(speed, GRAVITY * SINCE[-1] * np.array([x, y, -np.sqrt(1 - x * x - y * y)]), rtol=1e-9)


def test_winds_carry_along():
    start, medium = (0, 0, 0, 1, *([0] * 9)), ' density="1.2" wind="3 0 0"'
    steady = recorded(FLYING, effect_on("steady_wind", "world", velocity=[0.0, -4.0, 0.0]), start, medium=medium)
    plain = recorded(FLYING, (), start, medium=medium)
    assert plain[-1, 7] > 0.01 and abs(plain[-1, 8]) < 1e-12 and steady[-1, 8] < -0.01
    gusts = effect_on("periodic_wind", "world", amplitude=0.5, frequency=1.0, phase=0.3)
    push = np.gradient(recorded(FLYING, gusts, start, medium=medium)[:, 7], TIMES)[1:-1]
    calm = np.gradient(plain[:, 7], TIMES)[1:-1]
    expected = (1.0 + 0.5 * np.sin(2.0 * np.pi * TIMES[1:-1] + 0.3)) ** 2  # of the force, while the body is slow
    np.testing.assert_allclose(push / calm, expected, atol=0.04)  # measured: 0.028, the body takes up speed


def test_a_stop_bars_one_side():
    position = run(joint_effect("hard_stop", position=0.3), (0.0, 1.0))[:, 0]
    assert 0.3 < position.max() < 0.33 and position[-1] < 0.31  # MuJoCo's limit is soft
    np.testing.assert_allclose(run(joint_effect("hard_stop", position=0.3), (0.0, -1.0))[:, 0], -SINCE, atol=1e-9)


def test_a_stop_is_where_it_is_said_to_be_at_any_step():
    """Its force sets in at once: by steps that do not know of it, it was met too late."""
    swinging = FREE.replace('axis="1 0 0"/>', 'axis="1 0 0" stiffness="8"/>')
    stop = effect_on("hard_stop", "x", position=0.3)
    coarse, fine = (recorded(swinging, stop, (-0.4, 0.0), 0.0, finer=f)[:, 0] for f in (2, 128))
    np.testing.assert_allclose(coarse, fine, atol=1e-4)  # measured: 3e-5; by even steps 8e-4


def test_a_floating_body_weighs_less_and_one_that_takes_fluid_along_falls_slower():
    start = (0, 0, 0, 1, *([0] * 9))
    lifted = recorded(FLYING, effect_on("buoyancy", "block", volume=0.5), start)[:, 9]
    np.testing.assert_allclose(lifted, -GRAVITY * (1.0 - 1.2 * 0.5 / MASS) * SINCE, rtol=1e-9)
    slower = recorded(FLYING, effect_on("added_mass", "block", mass=3.0), start)[:, 9]
    np.testing.assert_allclose(slower, -GRAVITY * MASS / (MASS + 3.0) * SINCE, rtol=1e-9)


def test_a_tether_is_slack_within_its_length():
    tether = effect_on("tether", "block", stiffness=50.0, length=0.5, anchor=[-0.5, 0.0, 0.0])
    taut = SINCE < 0.3  # until the block comes back to where it is slack
    np.testing.assert_allclose(run(tether, (0.2, 0.0))[taut, 0], 0.2 * np.cos(5.0 * SINCE[taut]), atol=1e-6)
    assert np.abs(run(tether, (-0.1, 0.0))[:, 1]).max() == 0.0


def test_attraction_falls_with_the_square_of_the_distance():
    columns = run(effect_on("attraction", "block", strength=3.0, centre=[4.0, 0.0, 0.0]), (0.0, 0.5))
    energy = 0.5 * MASS * columns[:, 1] ** 2 - 3.0 / (4.0 - columns[:, 0])
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)
    assert columns[-1, 1] > 0.5


def test_what_is_at_rest_outside_turns_backwards_in_a_rotating_frame():
    rate = 1.3
    start = (1.0, 0, 0, 1, 0, 0, 0, 0, -rate, 0, 0, 0, -rate)
    columns = recorded(FLYING, effect_on("rotating_frame", "world", rate=[0.0, 0.0, rate]), start)
    circle = np.column_stack((np.cos(rate * SINCE), -np.sin(rate * SINCE)))
    np.testing.assert_allclose(columns[:, :2], circle, atol=1e-8)
    np.testing.assert_allclose(columns[:, -1], -rate, atol=1e-9)


def test_a_frame_that_turns_acts_on_spins():
    """A bar at rest outside keeps its way there: seen from inside it turns, whatever its inertia."""
    start = (0, 0, 0, 1, 0, 0, 0, 0, 0, 0, -0.4, 0, -0.9)
    bar = FLYING.replace('type="sphere" size="0.1"', 'type="box" size="0.3 0.1 0.05"')
    spin = recorded(bar, effect_on("rotating_frame", "world", rate=[0.4, 0.0, 0.9]), start)[:, -3:]
    np.testing.assert_allclose(spin, np.tile([-0.4, 0.0, -0.9], (len(spin), 1)), atol=1e-8)


def test_a_shaking_base_leaves_what_slides_behind():
    effect = effect_on("base_vibration", "world", amplitude=[0.02, 0.0, 0.0], frequency=1.5, phase=0.4)
    rate = 2.0 * np.pi * 1.5
    outside = run(effect, (0.0, 0.3))[:, 1] + 0.02 * rate * np.cos(rate * TIMES + 0.4)
    np.testing.assert_allclose(outside, 0.3 + 0.02 * rate * np.cos(-rate * PREROLL + 0.4), atol=1e-8)


def test_presliding_is_a_spring_until_it_slips():
    effect = joint_effect("hysteresis", force=10.0, stiffness=200.0)
    np.testing.assert_allclose(run(effect, (0.0, 0.2))[:, 0], 0.02 * np.sin(10.0 * SINCE), atol=1e-7)
    speed = run(effect, (0.0, 20.0))[:, 1]
    np.testing.assert_allclose(np.diff(speed), -10.0 / MASS * 0.01, atol=1e-9)


def test_a_servo_with_play_leaves_its_load_alone():
    play = joint_effect("backlash", gap=0.2)
    assert np.abs(recorded(SERVO, play, (0.0, 0.0), 0.05)).max() == 0.0
    pushed = recorded(SERVO, play, (0.0, 0.0), 0.3)
    shorter = recorded(SERVO, (), (0.0, 0.0), 0.2)
    first = SINCE < 0.3
    np.testing.assert_allclose(pushed[first], shorter[first], atol=1e-9)


def test_a_coupling_pulls_on_both():
    two = FREE.replace(
        "</worldbody>",
        """<body name="other"><joint name="y" type="slide" axis="0 1 0"/>
<geom type="sphere" size="0.1" mass="2"/></body></worldbody>""",
    ).split("<actuator>")[0]
    coupling = joint_effect("coupling", source="y", ratio=-1.0, stiffness=100.0, damping=0.0)
    columns = recorded(two, coupling, (0.1, 0.1, 0.0, 0.0))
    np.testing.assert_allclose(columns[:, 0] + columns[:, 1], 0.2 * np.cos(10.0 * SINCE), atol=1e-6)
    np.testing.assert_allclose(columns[:, 0] - columns[:, 1], 0.0, atol=1e-9)


def test_delay_shifts_and_holds_the_first_command():
    commands = np.where(TIMES < 0.5, 1.0, -1.0)
    delayed = run(effect_on("actuator_delay", "push", delay=0.123), (0.0, 0.0), commands)
    expected = np.where(TIMES < 0.623, SINCE, 0.623 + PREROLL - (TIMES - 0.623)) / MASS
    np.testing.assert_allclose(delayed[:, 1], expected, atol=1e-9)


def test_a_lag_approaches_the_command():
    commands = np.where(TIMES < 0.5, 0.0, 2.0)
    speed = run(effect_on("actuator_lag", "push", time_constant=0.2), (0.0, 0.0), commands)[:, 1]
    after = np.maximum(TIMES - 0.5, 0.0)
    np.testing.assert_allclose(speed, 2.0 / MASS * (after - 0.2 * (1.0 - np.exp(-after / 0.2))), atol=1e-7)


@pytest.mark.parametrize(
    ("name", "parameters", "push", "arrives"),
    [
        ("actuator_gain", {"ratio": 1.3}, 2.0, 2.6),
        ("actuator_bias", {"offset": -0.5}, 2.0, 1.5),
        ("actuator_dead_zone", {"width": 0.5}, -2.0, -1.5),
        ("actuator_dead_zone", {"width": 0.5}, 0.4, 0.0),
        ("actuator_saturation", {"limit": 1.2}, -2.0, -1.2),
    ],
)
def test_what_an_actuator_receives(name, parameters, push, arrives):
    speed = run(effect_on(name, "push", **parameters), (0.0, 0.0), push)[:, 1]
    np.testing.assert_allclose(speed, arrives / MASS * SINCE, atol=1e-9)


def test_a_positive_gain_drift_fades():
    speed = run(effect_on("actuator_gain_drift", "push", rate=0.8), (0.0, 0.0), 2.0)[:, 1]
    expected = 2.0 / MASS / 0.8 * (np.exp(0.8 * PREROLL) - np.exp(-0.8 * TIMES))
    np.testing.assert_allclose(speed, expected, rtol=1e-8)


def test_a_motor_weakens_with_speed():
    limit = effect_on("torque_speed_limit", "push", stall=3.0, no_load_speed=2.0)
    speed = run(limit, (0.0, 0.0), 50.0)[:, 1]
    np.testing.assert_allclose(speed, 2.0 * (1.0 - np.exp(-3.0 / 2.0 / MASS * SINCE)), rtol=1e-6)
    braking = run(limit, (0.0, 1.0), -50.0)[:, 1]
    np.testing.assert_allclose(braking[SINCE < 0.6], 1.0 - 3.0 / MASS * SINCE[SINCE < 0.6], rtol=1e-6)
    servo = recorded(SERVO, limit, (0.0, 0.0), 1e3)[:, 1]
    np.testing.assert_allclose(servo, speed, rtol=1e-6)


def test_a_servos_bias_is_a_force():
    bias = recorded(SERVO, effect_on("actuator_bias", "push", offset=0.1), (0.0, 0.0), 0.3)
    force = recorded(SERVO, joint_effect("constant_force", force=4.0), (0.0, 0.0), 0.3)
    np.testing.assert_allclose(bias, force, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "parameters", "expected"),
    [
        ("sensor_bias", {"offset": 0.25}, lambda x: x + 0.25),
        ("sensor_scale", {"ratio": 1.1}, lambda x: 1.1 * x),
        ("sensor_delay", {"delay": 0.034}, lambda x: x - 0.034),  # it moves at 1 m/s
        ("sensor_drift", {"rate": -0.2}, lambda x: x - 0.2 * TIMES),
    ],
)
def test_what_a_sensor_reads(name, parameters, expected):
    columns = run(effect_on(name, "qpos/x", **parameters), (0.1, 1.0))
    np.testing.assert_allclose(columns[:, 0], expected(0.1 + SINCE), atol=1e-9)
    np.testing.assert_allclose(columns[:, 1], 1.0, atol=1e-12)


def test_a_fast_clock_stamps_samples_and_commands_late():
    commands = np.where(TIMES < 0.5, 0.0, 2.0)
    columns = run(effect_on("clock_skew", "time", ratio=1.25), (0.0, 1.0), commands)
    after = np.maximum(TIMES - 0.5, 0.0) / 1.25  # true seconds since the switch
    np.testing.assert_allclose(columns[:, 1], 1.0 + 2.0 / MASS * after, atol=1e-9)


@pytest.mark.parametrize("name", [name for name, system in SYSTEMS.items() if not system.touching])
def test_reality_is_the_believed_model_when_nothing_is_concealed(name):
    rng = np.random.default_rng(7)
    for measured in (("qpos", "qvel"), ("qpos", "imu"), ("tracker",)):
        system = SYSTEMS[name].measuring(*measured)
        times = system.sampling[-1] * np.arange(60)
        psi = system.draw_psi(rng)
        start, inputs = system.draw_start(rng), system.draw_inputs(rng, times)
        real = simulate_reality(system, psi, (), start, times, inputs).columns
        believed = simulate_believed(system, system.compile(psi), start, times, inputs)
        # measured: 0.011 on the servo arm, below 0.001 elsewhere
        assert np.sqrt(np.mean(((real - believed) / system.noise()) ** 2)) < 0.03


@pytest.mark.parametrize("name", ["slider", "ball", "lift_arm", "puck"])
def test_every_law_moves_some_recording_and_stays_finite(name):
    rng, system = np.random.default_rng(3), SYSTEMS[name]
    probe = draw_probe(rng, system, system.draw_psi(rng), system.sampling[-1] * np.arange(30)).first()
    for law_name, law in LAWS.items():
        elements = [e for e in probe.scene.names(law.kind) if law.fits(probe.scene, e)]
        if law_name == INTEGRATION or not elements:
            continue
        parameters = law.parameters(
            0.1 * law.largest(probe.scene, elements[0]), law.draw(rng, probe.scene, elements[0])
        )
        changed = probe.with_effects(Effect(law_name, law.kind, elements[0], parameters))
        assert np.isfinite(probe.change(changed)), (law_name, parameters)


def test_every_law_acts_somewhere():
    rng, acting = np.random.default_rng(3), set()
    for name in ("cart_pole", "ball", "pan_tilt", "puck"):
        system = SYSTEMS[name]
        scene = draw_probe(rng, system, system.draw_psi(rng), system.sampling[-1] * np.arange(40)).scene
        acting |= {law for law in LAWS if any(LAWS[law].fits(scene, e) for e in scene.names(LAWS[law].kind))}
    assert acting == set(LAWS)
