"""Each concealed law against an analytic check of its sign and its unit."""

import dataclasses

import mujoco
import numpy as np
import pytest

from det2stoc_bayes.blind import laws
from det2stoc_bayes.blind.laws import Effect
from det2stoc_bayes.blind.reality import simulate_believed, simulate_reality
from det2stoc_bayes.blind.systems import SYSTEMS, System

MASS = 2.0
FREE = """<worldbody><body name="block"><joint name="x" type="slide" axis="1 0 0"/>
<geom type="sphere" size="0.1" mass="2"/></body></worldbody>
<actuator><motor name="push" joint="x"/></actuator></mujoco>"""
SPINNER = """<worldbody><body name="bar"><joint name="turn" type="hinge" axis="0 0 1"/>
<inertial pos="0.5 0 0" mass="2" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>"""
TIMES = 0.01 * np.arange(201)


def bare(xml: str, joint: str, body: str, actuators: tuple[str, ...] = ()) -> System:
    return dataclasses.replace(
        SYSTEMS["slider"], body_xml=xml, joints=(joint,), bodies=(body,), actuators=actuators, psi=()
    )


def run(effect: Effect | None, start: tuple[float, float], push: np.ndarray | float = 0.0) -> np.ndarray:
    commands = np.broadcast_to(np.asarray(push, float).reshape(-1, 1), (TIMES.size, 1)).copy()
    return simulate_reality(bare(FREE, "x", "block", ("push",)), {}, effect, np.array(start), TIMES, commands)


def joint_effect(name: str, **parameters: float) -> Effect:
    return Effect(name, "joint", "x", parameters)


def test_viscous_damping_decays_exponentially():
    speed = run(joint_effect("viscous_damping", coefficient=1.5), (0.0, 2.0))[:, 1]
    np.testing.assert_allclose(speed, 2.0 * np.exp(-1.5 * TIMES / MASS), rtol=1e-8)


def test_quadratic_damping_opposes_both_directions():
    for sign in (1.0, -1.0):
        speed = run(joint_effect("quadratic_damping", coefficient=0.8), (0.0, sign * 3.0))[:, 1]
        np.testing.assert_allclose(speed, sign * 3.0 / (1.0 + 0.8 * 3.0 * TIMES / MASS), rtol=1e-8)


def test_coulomb_friction_decelerates_evenly_and_holds():
    columns = run(joint_effect("coulomb_friction", force=3.0), (0.0, 1.5))
    moving = TIMES < 0.9 * 1.5 * MASS / 3.0
    np.testing.assert_allclose(columns[moving, 1], 1.5 - 3.0 / MASS * TIMES[moving], atol=5e-3)
    held = run(joint_effect("coulomb_friction", force=3.0), (0.0, 0.0), 2.0)
    assert np.abs(held[:, 1]).max() < 0.05  # MuJoCo's frictionloss creeps
    slipping = run(joint_effect("coulomb_friction", force=3.0), (0.0, 0.0), 5.0)
    assert slipping[-1, 1] == pytest.approx((5.0 - 3.0) / MASS * TIMES[-1], rel=0.02)


def test_springs_oscillate_about_rest():
    rest = 0.4
    columns = run(joint_effect("joint_spring", stiffness=50.0, rest=rest), (0.7, 0.0))
    np.testing.assert_allclose(columns[:, 0], rest + 0.3 * np.cos(5.0 * TIMES), atol=1e-6)
    cubic = run(joint_effect("cubic_stiffness", stiffness=40.0), (0.5, 0.0))
    energy = 0.5 * MASS * cubic[:, 1] ** 2 + 0.25 * 40.0 * cubic[:, 0] ** 4
    np.testing.assert_allclose(energy, 0.25 * 40.0 * 0.5**4, rtol=1e-6)
    assert cubic[5, 1] < 0.0


def test_constant_force_and_armature():
    pushed = run(joint_effect("constant_force", force=-1.2), (0.0, 0.0))
    np.testing.assert_allclose(pushed[:, 0], -0.5 * 1.2 / MASS * TIMES**2, atol=1e-9)
    heavier = run(joint_effect("armature", inertia=3.0), (0.0, 0.0), 2.0)
    np.testing.assert_allclose(heavier[:, 1], 2.0 / (MASS + 3.0) * TIMES, atol=1e-9)


def test_cogging_is_a_sine_of_position_with_phase():
    law = laws.JOINT_FORCES["cogging_torque"]
    parameters = {"amplitude": 0.3, "cycles": 10.0, "phase": 0.5}
    assert law(parameters, 0.2, 9.0) == pytest.approx(0.3 * np.sin(10.0 * 0.2 + 0.5))
    columns = run(joint_effect("cogging_torque", **parameters), (0.2, 0.1))
    energy = 0.5 * MASS * columns[:, 1] ** 2 + 0.03 * np.cos(10.0 * columns[:, 0] + 0.5)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)


def test_drag_acts_on_the_centre_of_mass():
    effect = Effect("quadratic_drag", "body", "bar", {"coefficient": 0.4})
    system = bare(SPINNER, "turn", "bar")
    rate = simulate_reality(system, {}, effect, np.array([0.0, 2.0]), TIMES, np.zeros((TIMES.size, 0)))[:, 1]
    inertia = 0.01 + MASS * 0.5**2
    np.testing.assert_allclose(rate, 2.0 / (1.0 + 0.4 * 0.5**3 * 2.0 * TIMES / inertia), rtol=1e-6)


def test_delay_shifts_and_holds_the_first_command():
    commands = np.where(TIMES < 0.5, 1.0, -1.0)
    delayed = run(Effect("actuator_delay", "actuator", "push", {"delay": 0.123}), (0.0, 0.0), commands)
    expected = np.where(TIMES < 0.623, TIMES, 2.0 * 0.623 - TIMES) / MASS
    np.testing.assert_allclose(delayed[:, 1], expected, atol=1e-9)


def test_gain_multiplies_and_bias_adds():
    stronger = run(Effect("actuator_gain", "actuator", "push", {"ratio": 1.3}), (0.0, 0.0), 2.0)
    np.testing.assert_allclose(stronger[:, 1], 1.3 * 2.0 / MASS * TIMES, atol=1e-9)
    biased = run(Effect("sensor_bias", "sensor", "qvel/x", {"offset": 0.25}), (0.1, 1.0))
    np.testing.assert_allclose(biased, np.column_stack((0.1 + TIMES, np.full(TIMES.size, 1.25))), atol=1e-9)


@pytest.mark.parametrize("name", SYSTEMS)
def test_reality_is_the_believed_model_when_nothing_is_concealed(name):
    system, rng = SYSTEMS[name], np.random.default_rng(7)
    times = 0.02 * np.arange(150)
    for _ in range(3):
        psi, start, inputs = system.draw_psi(rng), system.draw_start(rng), system.draw_inputs(rng, times)
        real = simulate_reality(system, psi, None, start, times, inputs)
        believed = simulate_believed(system.compile(psi), start, times, inputs)
        assert np.sqrt(np.mean(((real - believed) / system.noise()) ** 2)) < 0.01


def test_every_law_leaves_other_runs_alone():
    assert laws.force_of(mujoco.MjModel.from_xml_string(SYSTEMS["arm"].xml()), None) is None
    values = np.ones((3, 2))
    assert laws.measure(None, ["qpos/x", "qvel/x"], values) is values
