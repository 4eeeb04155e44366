"""The C engine against plain mj_step and closed forms."""

import os
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from catalogue import VALUES, place_form
from conftest import ARM, CARTPOLE, FREE, HINGE, MOTORS, SLIDE, blank_recording, make_study, model_xml

from det2stoc_bayes.engines import mujoco_c
from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.engines.mujoco_c import MujocoC
from det2stoc_bayes.mismatch.effects import CATALOGUE, Element, PlacedEffect, Typical
from det2stoc_bayes.problem import merge_requests
from det2stoc_bayes.segments import cut
from det2stoc_bayes.simulator import Simulator

BALL = '<body name="ball"><joint name="{0}" type="slide" axis="{1}"/><geom size="0.1" mass="2"/></body>'


def request(model, time, qpos, qvel, fields=None, ctrl=None, columns=None, effects=()):
    """Simulations of one blank recording from several starts."""
    segments = cut([blank_recording(model, time, columns, ctrl)])
    start = Start(
        np.atleast_2d(qpos).astype(float),
        np.atleast_2d(qvel).astype(float),
        np.zeros((len(np.atleast_2d(qpos)), model.na)),
    )
    return Request(segments, np.zeros(len(start.qpos), int), start, fields or {}, effects)


def stepped(model, qpos, qvel, num_steps, ctrl=lambda t: 0.0):
    """States at every step by plain mj_step."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    states = [np.concatenate([data.qpos, data.qvel])]
    for _ in range(num_steps):
        data.ctrl[:] = ctrl(data.time)
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(states)


@pytest.mark.parametrize("bodies", [HINGE, SLIDE, CARTPOLE, ARM, FREE])
def test_moves_as_mj_step(compiled, bodies):
    model = compiled(bodies)
    rng = np.random.default_rng(0)
    qpos, qvel = model.qpos0 + 0.2 * (model.nq == model.nv), rng.standard_normal(model.nv)
    time = np.arange(11) * 0.02
    out = MujocoC(model, 1).rollout(request(model, time, qpos, qvel))[0]
    order = stepped(model, qpos, qvel, 100)[::10]
    if model.nq == model.nv:  # columns alternate position and velocity of each joint
        order = order.reshape(11, 2, model.nv).transpose(0, 2, 1).reshape(11, -1)
    np.testing.assert_allclose(out, order, rtol=0, atol=1e-13)


def test_contacts_are_looked_for_only_where_there_may_be_some():
    cloth = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
      <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2" pos="0 0 .2" mass=".1" radius=".01">
      <edge equality="true"/></flexcomp></worldbody></mujoco>"""
    disabled = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for xml, looked_for in ((cloth, True), (model_xml(ARM), False)):
        model = mujoco.MjModel.from_xml_string(xml)
        engine = MujocoC(model, 1)
        assert bool(engine._model(None, None).opt.disableflags & disabled) != looked_for
        assert not model.opt.disableflags & disabled  # the caller's own stays as it is


@pytest.mark.parametrize(("count", "threads"), [(5, 1), (500, 2)])
def test_few_simulations_that_are_stepped_together_do_not_wait_for_threads(compiled, monkeypatch, count, threads):
    model, taken = compiled(HINGE), []
    batch = mujoco.batch.Batch

    def watched(model, count, threads, **options):
        taken.append(threads)
        return batch(model, count, threads, **options)

    monkeypatch.setattr(mujoco.batch, "Batch", watched)
    effects = (EffectRows.alike(place_form(model, "StribeckFriction"), count, VALUES["StribeckFriction"]),)
    ask = request(model, np.arange(3) * 0.02, np.zeros((count, 1)), np.zeros((count, 1)), effects=effects)
    MujocoC(model, 2).rollout(ask)
    assert taken == [threads]


def test_free_fall(compiled):
    model = compiled(BALL.format("drop", "0 0 1"), option='<option timestep="0.001" integrator="RK4"/>')
    time = np.linspace(0, 1, 21)
    out = MujocoC(model).rollout(request(model, time, [3.0], [1.0]))[0]
    np.testing.assert_allclose(out[:, 0], 3 + time - 0.5 * 9.81 * time**2, atol=1e-12)


def test_undamped_pendulum_keeps_its_energy(compiled):
    model = compiled(HINGE.replace('damping="0.05"', ""), integrator="RK4")
    out = MujocoC(model).rollout(request(model, np.linspace(0, 10, 201), [-1.5], [0.0]))[0]
    data, energy = mujoco.MjData(model), []
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    for q, v in out:
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        energy.append(data.energy.sum())
    assert np.ptp(out[:, 0]) > 1
    assert np.ptp(energy) < 1e-7


def test_damping_decays_exponentially(compiled):
    model = compiled(BALL.format("run", "1 0 0"), option='<option timestep="0.0005" gravity="0 0 0"/>')
    time = np.linspace(0, 2, 21)
    out = MujocoC(model).rollout(request(model, time, [0.0], [1.5], {"dof_damping": np.array([[3.0]])}))[0]
    np.testing.assert_allclose(out[:, 1], 1.5 * np.exp(-1.5 * time), rtol=2e-3)


def test_frictionloss_decelerates_evenly_and_stops(compiled):
    model = compiled(BALL.format("run", "1 0 0"), option='<option timestep="0.001" gravity="0 0 0"/>')
    time = np.linspace(0, 2, 41)
    out = MujocoC(model).rollout(request(model, time, [0.0], [1.0], {"dof_frictionloss": np.array([[2.0]])}))[0]
    np.testing.assert_allclose(out[:, 1], np.clip(1 - time, 0, None), atol=5e-3)
    assert np.ptp(out[time > 1.1, 0]) < 1e-3


def test_chunks_change_nothing(compiled, monkeypatch):
    model, rng = compiled(ARM, MOTORS), np.random.default_rng(1)
    time, n = np.arange(11) * 0.013, 7
    placed = PlacedEffect(CATALOGUE["constant_force"], Element("joint", "elbow", True, 1, 1, 2), Typical())
    effects = (EffectRows(placed, slice(2, 6), {"force": rng.standard_normal(4)}),)
    asked = request(
        model,
        time,
        rng.standard_normal((n, 2)),
        rng.standard_normal((n, 2)),
        {"body_mass": model.body_mass * rng.uniform(0.5, 2, (n, 1))},
        rng.standard_normal((11, 2)),
        effects=effects,
    )
    whole = MujocoC(model).rollout(asked)
    monkeypatch.setattr(mujoco_c, "MAX_SIMULATIONS", 3)
    np.testing.assert_array_equal(MujocoC(model).rollout(asked), whole)


def test_simulations_that_run_in_different_ways_come_back_in_order(compiled):
    """Some in C alone, some whose force is set at every step, some that are pushed on a body."""
    model, rng = compiled(ARM, MOTORS), np.random.default_rng(2)
    forms = ["ViscousDamping", "QuadraticDrag", "QuadraticDrag", "CoggingTorque", "ViscousDamping", "CoggingTorque"]
    time, n = np.arange(11) * 0.013, len(forms)
    qpos, qvel = rng.standard_normal((n, 2)), rng.standard_normal((n, 2))

    def alone(i):
        values = {name: np.array([v]) for name, v in VALUES[forms[i]].items()}
        effects = (EffectRows(place_form(model, forms[i]), slice(0, 1), values),)
        return request(model, time, qpos[i], qvel[i], effects=effects)

    each = [alone(i) for i in range(n)]
    segments = each[0].segments
    together = MujocoC(model).rollout(merge_requests([replace(r, segments=segments) for r in each]))
    still = MujocoC(model).rollout(request(model, time, qpos, qvel))
    assert (np.abs(together - still).max((1, 2)) > 1e-4).all()
    np.testing.assert_allclose(together, np.concatenate([MujocoC(model).rollout(r) for r in each]), atol=1e-12)


@pytest.mark.parametrize("held", [False, True])
def test_a_diverging_simulation_is_alone_and_silent(compiled, capfd, monkeypatch, tmp_path, held):
    monkeypatch.chdir(tmp_path)
    model = compiled(CARTPOLE)
    effects = ()
    if held:
        placed = PlacedEffect(CATALOGUE["constant_force"], Element("joint", "rail", False, 0, 0, 1), Typical())
        effects = (EffectRows(placed, slice(0, 3), {"force": np.zeros(3)}),)
    damping = np.array([[0.2, 0.01], [-1e6, -1e6], [0.2, 0.01]])
    asked = request(
        model,
        np.arange(41) * 0.05,
        np.full((3, 2), 0.1),
        np.ones((3, 2)),
        {"dof_damping": damping},
        effects=effects,
    )
    out = MujocoC(model).rollout(asked)
    assert np.isnan(out[1]).all()
    alone = MujocoC(model).rollout(
        replace(
            asked,
            which=asked.which[:1],
            start=asked.start[:1],
            effects=(),
            fields={k: v[:1] for k, v in asked.fields.items()},
        )
    )
    np.testing.assert_allclose(out[[0, 2]], np.concatenate([alone, alone]), atol=1e-12)
    assert capfd.readouterr() == ("", "")
    assert os.listdir(tmp_path) == []


def test_known_fields_act_on_their_recording_alone(tmp_path):
    time = np.arange(6) * 0.02
    series = {"qpos/slide": np.zeros(6), "qvel/slide": np.zeros(6)}
    toml = '[psi.damping]\ntarget = "joint/slide/damping"\nprior = { HalfNormal = { scale = 0.3 } }\n'
    toml += '[known.b]\n"body/block/mass" = 4.0\n'
    study = make_study(tmp_path / "s", model_xml(SLIDE), toml, dict.fromkeys("abc", (time, series)))
    simulator = Simulator(study)
    fields = simulator.fields(np.array([[0.1], [0.2], [0.3]]), ["a", "b", "c"])
    np.testing.assert_array_equal(fields["body_mass"], [[0, 1.3], [0, 4.0], [0, 1.3]])
    np.testing.assert_array_equal(fields["dof_damping"], [[0.1], [0.2], [0.3]])
    segments = cut(study.recordings)
    start = Start(np.full((3, 1), 0.5), np.zeros((3, 1)), np.zeros((3, 0)))
    fields["dof_damping"][:] = 0.3
    out = simulator.rollout(Request(segments, np.arange(3), start, fields))
    np.testing.assert_array_equal(out[0], out[2])
    assert np.abs(out[0] - out[1]).max() > 1e-4


def test_a_sample_between_steps_is_reached_by_a_shorter_step(compiled):
    model = compiled(ARM, MOTORS)
    time = np.array([0.0, 0.004, 0.0101, 0.0199, 0.03])
    ctrl = np.random.default_rng(2).standard_normal((5, 2))
    out = MujocoC(model).rollout(request(model, time, [0.1, 0.2], [0.0, 0.0], ctrl=ctrl))[0]

    held = np.repeat([0, 1, 2, 3, 4], [2, 3, 5, 5, 1])  # at each step, but for what comes within it
    mixed = {5: 0.05 * ctrl[1] + 0.95 * ctrl[2], 9: 0.95 * ctrl[2] + 0.05 * ctrl[3]}
    states = stepped(
        model, [0.1, 0.2], [0.0, 0.0], 15, lambda t: mixed.get(round(t / 0.002), ctrl[held[round(t / 0.002)]])
    )
    expected = states[[0, 2, 5, 9, 15]]
    for sample, command, last, length in ((2, ctrl[1], 5, 0.0001), (3, ctrl[2], 9, 0.0019)):
        model.opt.timestep = length
        expected[sample] = stepped(model, states[last, :2], states[last, 2:], 1, lambda t, u=command: u)[1]
    np.testing.assert_allclose(out, expected[:, [0, 2, 1, 3]], atol=1e-13)


@pytest.mark.parametrize(("integrator", "allowed"), [("RK4", (5e-5, 1.2e-3)), ("Euler", (2e-3, 0.05))])
def test_samples_between_steps_follow_the_motion(compiled, integrator, allowed):
    """An oscillator's closed form; RK4 is off by 3e-5 and 8e-4, straight lines between its steps by 1e-3, 0.04."""
    spring = """<body name="b"><joint name="s" type="slide" axis="1 0 0" stiffness="900"/>
      <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body>"""
    model = compiled(spring, integrator=integrator)
    model.opt.timestep = 0.005 if integrator == "RK4" else 0.0001
    time = np.concatenate([[0.0], np.sort(np.random.default_rng(3).uniform(0.0, 0.5, 60))])
    out = MujocoC(model).rollout(request(model, time, [0.5], [0.0]))[0]
    expected = np.stack([0.5 * np.cos(30 * time), -15 * np.sin(30 * time)], 1)
    error = np.abs(out - expected).max(0)
    assert (error < allowed).all(), error


@pytest.mark.parametrize("form", [None, "ActuatorLag", "StribeckFriction", "LinearDrag", "PeriodicForce"])
def test_commands_that_come_within_steps_act_from_their_samples_on(compiled, form):
    """Against steps twenty times shorter; the straight line between steps is off by 0.57 and 2.5 rad/s (lag: 0.2)."""
    model = compiled(ARM, MOTORS, "RK4")
    model.opt.timestep = 0.004
    rng = np.random.default_rng(3)
    time = np.concatenate([[0.0], np.cumsum(rng.uniform(0.005, 0.02, 40))])
    acting = {} if form is None else {place_form(model, form): VALUES[form]}
    effects = tuple(EffectRows.alike(placed, 1, values) for placed, values in acting.items())
    asked = request(model, time, [0.1, 0.2], [0.0, 0.0], ctrl=rng.standard_normal((41, 2)), effects=effects)
    engine = MujocoC(model)
    off = np.abs(engine.rollout(asked) - engine.rollout(replace(asked, timestep=0.0002)))[0].max(0)
    assert (off[[1, 3]] < [0.07, 0.3]).all(), off  # measured: at most 0.054 and 0.23
    assert (off[[0, 2]] < 0.004).all(), off  # measured: at most 0.0033


@pytest.mark.parametrize(
    ("field", "edit"),
    [
        ("body_mass", lambda s: setattr(s.body("lower"), "mass", 2.0)),
        ("dof_armature", lambda s: setattr(s.joint("elbow"), "armature", 0.3)),
        ("body_inertia", lambda s: setattr(s.body("lower"), "inertia", [0.02, 0.03, 0.01])),
    ],
)
def test_a_changed_inertia_moves_as_a_recompiled_model(field, edit):
    bodies = ARM.replace("<geom", '<geom group="0"')
    spec = mujoco.MjSpec.from_string(model_xml(bodies))
    model = spec.compile()
    for body in spec.bodies[1:]:  # inertias of their own, so that they can be edited
        b = model.body(body.name)
        body.explicitinertial, body.mass, body.ipos, body.iquat, body.inertia = (
            True,
            b.mass[0],
            b.ipos,
            b.iquat,
            b.inertia,
        )
    edit(spec)
    edited = spec.compile()
    value = getattr(edited, field)[None]
    assert np.abs(value - getattr(model, field)).max() > 1e-3
    time = np.arange(21) * 0.02
    out = MujocoC(model).rollout(request(model, time, [0.3, 0.1], [1.0, -1.0], {field: value}))[0]
    expected = stepped(edited, [0.3, 0.1], [1.0, -1.0], 200)[::10][:, [0, 2, 1, 3]]
    np.testing.assert_allclose(out, expected, atol=1e-12)


def test_friction_follows_a_changed_mass():
    # The weights of the constraint solver are derived from the masses.
    xml = model_xml(SLIDE.replace("damping", 'frictionloss="0.5" damping'))
    model, edited = (
        mujoco.MjModel.from_xml_string(xml),
        mujoco.MjModel.from_xml_string(xml.replace("1.3", "5")),
    )
    time = np.arange(21) * 0.02
    out = MujocoC(model).rollout(
        request(
            model,
            time,
            [0.3],
            [1.0],
            {"body_mass": edited.body_mass[None], "body_inertia": edited.body_inertia[None]},
        )
    )[0]
    np.testing.assert_allclose(out, stepped(edited, [0.3], [1.0], 200)[::10], atol=1e-12)


def test_sensors_describe_the_state_before_the_step(compiled):
    model = compiled(HINGE, '<sensor><jointvel name="speed" joint="hinge"/></sensor>')
    time = np.arange(5) * 0.002
    out = MujocoC(model).rollout(request(model, time, [0.4], [-1.0], columns=["qvel/hinge", "sensor/speed"]))[0]
    np.testing.assert_array_equal(out[:-1, 0], out[:-1, 1])


def test_counts_what_it_ran(compiled):
    model = compiled(HINGE)
    engine = MujocoC(model)
    engine.rollout(request(model, np.arange(6) * 0.02, np.zeros((4, 1)), np.zeros((4, 1))))
    assert (engine.counter.simulations, engine.counter.steps) == (4, 4 * 50)


def test_a_simple_body_takes_another_centre_of_mass(tmp_path):
    """MuJoCo compiles a lone free body in a form that has its centre of mass fixed."""
    toml = '[psi.offset]\ntarget = "body/stone/ipos"\nindex = [0]\nprior = { Normal = { scale = 0.1 } }\n'
    study = make_study(tmp_path / "stone", model_xml(FREE), toml)
    simulator = Simulator(study)
    segments = cut(study.recordings)
    model = mujoco.MjModel.from_xml_string(model_xml(FREE))
    offset = 0.03
    start = Start(model.qpos0[None], np.array([[0.0, 0, 0, 3, 2, 1]]), np.zeros((1, 0)))
    fields = simulator.fields(np.array([[offset]]), ["one"])
    found = simulator.rollout(Request(segments, np.zeros(1, int), start, fields))
    inertia = " ".join(map(str, model.body_inertia[1]))
    body = FREE.replace("</body>", f'<inertial pos="{offset} 0 0" mass="0.8" diaginertia="{inertia}"/></body>')
    reference = mujoco.MjModel.from_xml_string(model_xml(body))
    data = mujoco.MjData(reference)
    data.qvel[:] = start.qvel[0]
    for _ in range(250):
        mujoco.mj_step(reference, data)
    np.testing.assert_allclose(found[0, -1, :7], data.qpos, atol=1e-9)
