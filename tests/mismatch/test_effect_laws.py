"""Each effect's law, sign and unit against a plain MuJoCo loop that is written by hand; frictions that hold at rest."""

import mujoco
import numpy as np
import pytest
from catalogue import AIR, FORMS, VALUES, place_form
from conftest import ARM, MOTORS, blank_recording, make_study, model_xml, state_columns
from scipy.interpolate import CubicHermiteSpline

from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.engines.mujoco_c import MujocoC
from det2stoc_bayes.mismatch.effects import CATALOGUE, Element, PlacedEffect, Typical
from det2stoc_bayes.segments import cut
from det2stoc_bayes.simulator import Simulator

DT, TIME = 0.002, np.arange(61) * 0.01
XML = model_xml(ARM, MOTORS, option=AIR.format("Euler"))
STILL = model_xml(ARM, MOTORS)  # MuJoCo takes the fluid's forces on a body from its inertia, and so on a payload
CTRL = 0.5 + np.sin(np.outer(TIME, [9.0, 7.0]))
START = ([0.4, -0.3], [1.0, -2.0])
SERVO, ELBOW, LOWER = 1, 1, 2  # actuator, degree of freedom, body


def by_hand(edit=None, before=None, command=lambda u, t: u[-1], read=lambda x, t: x, xml=XML, every=5):
    """Shoulder and elbow at TIME. `edit` changes the spec, `before` acts before a step."""
    spec = mujoco.MjSpec.from_string(xml)
    first = spec.compile()
    if edit is not None:
        edit(spec, first)
    model = spec.compile()
    data, rows, given = mujoco.MjData(model), [], []
    data.qpos[:], data.qvel[:] = START
    for k in range(round(TIME[-1] / DT) + 1):
        if k % every == 0:
            rows.append([data.qpos[0], data.qvel[0], data.qpos[1], data.qvel[1]])
        given.append(CTRL[k // 5, SERVO])
        data.ctrl[:] = CTRL[k // 5]
        data.ctrl[SERVO] = command(np.array(given), np.arange(k + 1) * DT)
        data.qfrc_applied[:], data.xfrc_applied[:] = 0.0, 0.0
        if before is not None:
            mujoco.mj_forward(model, data)
            before(model, data)
        mujoco.mj_step(model, data)
    return read(np.array(rows), TIME)


def force(law):
    """A generalized force on the elbow."""

    def before(m, d):
        d.qfrc_applied[ELBOW] = law(d.qpos[ELBOW], d.qvel[ELBOW], d.time)

    return {"before": before}


def push(law):
    """A force on the lower arm's centre of mass, from its velocity and spin in the world."""

    def before(m, d):
        jacp, jacr = np.zeros((3, m.nv)), np.zeros((3, m.nv))
        mujoco.mj_jacBodyCom(m, d, jacp, jacr, LOWER)
        d.xfrc_applied[LOWER, :3] = law(jacp @ d.qvel, jacr @ d.qvel)

    return {"before": before}


def unit(x):
    return x / np.linalg.norm(x)


def pull(law):
    """A force on the lower arm's centre of mass, from where it is."""

    def before(m, d):
        d.xfrc_applied[LOWER, :3] = law(d.xipos[LOWER])

    return {"before": before}


def turning(m, d):
    """Fictitious forces on points that together have each body's mass, centre and inertia."""
    rate = np.array([0.4, 0.7, -1.2])
    for b in (1, 2):
        jac, axes = np.zeros((3, m.nv)), d.ximat[b].reshape(3, 3)
        second = np.sum(m.body_inertia[b]) / 2 - m.body_inertia[b]  # of mass along the principal axes
        for axis, moment in zip(axes.T, second, strict=True):
            arm = np.sqrt(moment / (m.body_mass[b] / 3))
            for point in (d.xipos[b] + arm * axis, d.xipos[b] - arm * axis):
                mujoco.mj_jac(m, d, jac, None, point, b)
                felt = 2 * np.cross(rate, jac @ d.qvel) + np.cross(rate, np.cross(rate, point))
                d.qfrc_applied += jac.T @ (-m.body_mass[b] / 6 * felt)


def rewrite(change):
    """Changes the model before each step."""
    return {"before": change}


def last(law):
    """What arrives of the latest command."""
    return {"command": lambda u, t: law(u[-1], t[-1])}


def inertial(change):
    """Edits the lower arm's mass distribution, made explicit."""

    def edit(spec, model):
        body = spec.body("lower")
        body.explicitinertial = True
        b = model.body("lower")
        body.mass, body.ipos, body.iquat, body.inertia = b.mass[0], b.ipos, b.iquat, b.inertia
        change(body)

    return {"edit": edit}


def payload(spec, model):
    """A ball of almost no size, welded on."""
    ball = spec.body("lower").add_body(pos=VALUES["PayloadMass"]["offset"])
    ball.mass, ball.explicitinertial = 0.2, True
    ball.ipos, ball.inertia = [0, 0, 0], [1e-12] * 3


def option(**changes):
    """Edits the options."""

    def edit(spec, model):
        for name, value in changes.items():
            setattr(spec.option, name, value)

    return {"edit": edit}


def lag(u, t):
    """The mean over the last step of the solution of T dy/dt = u - y that starts settled."""
    y, tau = u[0], VALUES["ActuatorLag"]["time_constant"]
    for x in u:
        fine = y + (x - y) * (1 - np.exp(-np.linspace(0, DT, 201) / tau))
        y, mean = fine[-1], np.trapezoid(fine, dx=DT / 200) / DT
    return mean


def late(u, t):
    """Linear between steps."""
    return np.interp(t[-1] - VALUES["ActuatorDelay"]["delay"], t, u)


def loose(m, d):
    error, speed = d.ctrl[SERVO] - d.qpos[ELBOW], d.qvel[ELBOW]
    wanted = 8 * error - 0.3 * speed  # the servo's, of which the gap takes up to half its width
    d.qfrc_applied[ELBOW] = -np.sign(wanted) * min(abs(wanted), 8 * 0.05)


def coupled(m, d):
    apart, faster = d.qpos[ELBOW] - 0.8 * d.qpos[0], d.qvel[ELBOW] - 0.8 * d.qvel[0]
    pull = 4.0 * apart + 0.1 * faster
    d.qfrc_applied[:] = [0.8 * pull, -pull]


class Jenkins:
    """A spring's force by its increments, cut off at the largest."""

    def __init__(self):
        self.before, self.now = None, 0.0

    def __call__(self, q, v, t):
        if t == 0.0:
            self.before, self.now = q, 0.0
        self.now = min(max(self.now - 6.0 * (q - self.before), -0.3), 0.3)
        self.before = q
        return self.now


def stribeck(m, d):
    v = d.qvel[ELBOW]
    m.dof_frictionloss[ELBOW] = 0.15 + (0.4 - 0.15) * np.exp(-((v / 0.6) ** 2))


def loaded(m, d):
    q, v, u = d.qpos[ELBOW], d.qvel[ELBOW], d.ctrl[SERVO]
    m.dof_frictionloss[ELBOW] = 0.12 * abs(8 * (u - q) - 0.3 * v)


def shaken(m, d):
    rate = 2 * np.pi * 3.0
    m.opt.gravity[:] = np.array([0, 0, -9.81]) + rate**2 * np.array([0.01, 0.004, -0.02]) * np.sin(rate * d.time + 0.7)


def limited(m, d):
    speed = d.qvel[ELBOW]
    m.actuator_forcelimited[SERVO] = True
    ahead = 0.9 * min(max(1 - abs(speed) / 3.0, 0), 1)
    m.actuator_forcerange[SERVO] = [-0.9, ahead] if speed > 0 else [-ahead, 0.9]


def gust(m, d):
    m.opt.wind[:] = np.array([1.5, 0.4, -0.7]) * (1 + 0.8 * np.sin(2 * np.pi * 1.5 * d.time + 0.7))


def catmull_rom(values, least, most):
    """A cubic Hermite spline whose slopes are central differences; it stays as it ends."""
    x, padded = np.linspace(least, most, len(values)), np.pad(np.array(values), 1, mode="edge")
    curve = CubicHermiteSpline(x, values, (padded[2:] - padded[:-2]) / (2 * (x[1] - x[0])))
    return lambda at: curve(np.clip(at, least, most))


def spline(p):
    return catmull_rom(p["curve"], p["least"], p["most"])


def surface(p, first, second):
    rows = np.reshape(p["curve"], (24, 8))
    along = [catmull_rom(row, p["least"][1], p["most"][1])(second) for row in rows]
    return catmull_rom(along, p["least"][0], p["most"][0])(first)


def commanded(m, d):
    d.qfrc_applied[ELBOW] = spline(VALUES["OverCommand"])(d.ctrl[SERVO])


def column(law):
    """The elbow's speed as it is recorded."""

    def read(rows, t):
        rows = rows.copy()
        rows[:, 3] = law(rows[:, 3], t)
        return rows

    return {"read": read}


def field(name, value):
    """Adds to a field of the elbow."""

    def before(m, d):
        getattr(m, name)[ELBOW] = value

    return {"before": before}


def armature(spec, model):
    spec.joint("elbow").armature += 0.05


def stopped(spec, model):
    spec.joint("elbow").limited, spec.joint("elbow").range = True, np.rad2deg([-100.0, VALUES["HardStop"]["position"]])


def damped(spec, model):
    spec.joint("elbow").damping[0] += 0.3


AREA = (4 * np.pi * 0.025 * (0.025 + np.hypot(0.25, 0.05) / 2)) / 4
LEAN = np.sin([0.1, -0.05])
G = 9.81 * np.array([*LEAN, -np.sqrt(1 - LEAN @ LEAN)])
LAWS = {
    "ViscousDamping": {"edit": damped},
    "CoulombFriction": field("dof_frictionloss", 0.2),
    "StribeckFriction": rewrite(stribeck),
    "QuadraticDamping": force(lambda q, v, t: -0.4 * abs(v) * v),
    "LoadDependentFriction": rewrite(loaded),
    "JointSpring": force(lambda q, v, t: -2.0 * (q - 0.3)),
    "CubicStiffness": force(lambda q, v, t: -30.0 * q**3),
    "ConstantForce": force(lambda q, v, t: 0.7),
    "Armature": {"edit": armature},
    "CoggingTorque": force(lambda q, v, t: 0.3 * np.sin(9 * q + 0.4)),
    "PeriodicForce": force(lambda q, v, t: 0.4 * np.sin(2 * np.pi * 2.5 * t + 0.4)),
    "HardStop": {"edit": stopped},
    "Backlash": rewrite(loose),
    "Hysteresis": force(Jenkins()),
    "Coupling": rewrite(coupled),
    "LinearDrag": push(lambda v, w: -0.6 * v),
    "QuadraticDrag": push(lambda v, w: -0.6 * np.linalg.norm(v) * v),
    "SizedDrag": push(lambda v, w: -0.5 * 1.2 * AREA * 20 * np.linalg.norm(v) * v),
    "MagnusLift": push(lambda v, w: 1.5 * np.cross(w, v)),
    "Buoyancy": push(lambda v, w: [0, 0, 40 * 0.004 * 9.81]),
    "AddedMass": inertial(lambda b: setattr(b, "mass", 0.8)) | push(lambda v, w: [0, 0, 0.2 * 9.81]),
    "Tether": pull(lambda x: -20 * max(np.linalg.norm(x - [0.2, 0.1, 0.6]) - 0.3, 0) * unit(x - [0.2, 0.1, 0.6])),
    "Attraction": pull(lambda x: -0.3 * unit(x - [0.9, 0.2, 0.4]) / np.sum((x - [0.9, 0.2, 0.4]) ** 2)),
    "PayloadMass": {"edit": payload, "xml": STILL},
    "MassError": inertial(lambda b: (setattr(b, "inertia", b.inertia * 0.75), setattr(b, "mass", 0.45))),
    "ComOffset": inertial(lambda b: setattr(b, "ipos", b.ipos + [0.03, 0.01, -0.02])),
    "InertiaError": inertial(lambda b: setattr(b, "inertia", b.inertia * [1.42, 1.4, 1.2])),
    "GravityTilt": option(gravity=G),
    "GravityError": option(gravity=[0, 0, -10.31]),
    "SteadyWind": option(wind=[3.5, -0.1, 0.3]),
    "PeriodicWind": rewrite(gust),
    "RotatingFrame": rewrite(turning),
    "BaseVibration": rewrite(shaken),
    "ActuatorDelay": {"command": late},
    "ActuatorLag": {"command": lag},
    "ActuatorGain": last(lambda u, t: 1.7 * u),
    "ActuatorBias": last(lambda u, t: u + 0.2),
    "ActuatorDeadZone": last(lambda u, t: 0.0 if abs(u) < 0.15 else u - 0.15 * np.sign(u)),
    "ActuatorSaturation": last(lambda u, t: min(max(u, -0.35), 0.35)),
    "ActuatorGainDrift": last(lambda u, t: u * np.exp(-0.6 * (t + DT / 2))),
    "TorqueSpeedLimit": rewrite(limited),
    "OverPosition": force(lambda q, v, t: spline(VALUES["OverPosition"])(q)),
    "OverVelocity": force(lambda q, v, t: spline(VALUES["OverVelocity"])(v)),
    "OverTime": force(lambda q, v, t: spline(VALUES["OverTime"])(t)),
    "OverCommand": rewrite(commanded),
    "OverPositionAndVelocity": force(lambda q, v, t: surface(VALUES["OverPositionAndVelocity"], q, v)),
    "OverTimeAndVelocity": force(lambda q, v, t: surface(VALUES["OverTimeAndVelocity"], t, v)),
    "OverTimeAndPosition": force(lambda q, v, t: surface(VALUES["OverTimeAndPosition"], t, q)),
    "SensorBias": column(lambda y, t: y + 0.1),
    "SensorScale": column(lambda y, t: 1.1 * y),
    "SensorDelay": column(lambda y, t: y),
    "SensorDrift": column(lambda y, t: y + 0.3 * t),
}
ROUGH = {"QuadraticDamping": 0.08}  # measured: 0.05; MuJoCo takes damping implicitly, the hand explicitly


def simulated(folder, form, values):
    """The engine's columns with an effect, on a study's simulator."""
    study = make_study(folder / "arm", LAWS.get(form, {}).get("xml", XML))
    simulator = Simulator(study, num_threads=1)
    placed = place_form(simulator.model, form)
    segments = cut([blank_recording(simulator.model, TIME, state_columns(simulator.model), CTRL)])
    start = Start(np.array([START[0]]), np.array([START[1]]), np.zeros((1, 0)))
    fields = simulator.fields(simulator.believed[None], ["blank"])
    return simulator.rollout(
        Request(segments, np.zeros(1, int), start, fields, (EffectRows.alike(placed, 1, values),))
    )[0]


@pytest.mark.parametrize("form", [f for f in LAWS if f != "SensorDelay"])
def test_moves_as_by_hand(tmp_path, form):
    found, expected = simulated(tmp_path, form, VALUES[form]), by_hand(**LAWS[form])
    plain = by_hand(xml=LAWS[form].get("xml", XML))
    error, effect = np.abs(found - expected).max(), np.abs(expected - plain).max()
    print(f"{form}: {error:.1e} of {effect:.1e}")
    assert effect > 1e-3
    assert error < ROUGH.get(form, 1e-6) * effect


def test_a_late_column_shows_the_past(tmp_path):
    found, plain = simulated(tmp_path, "SensorDelay", VALUES["SensorDelay"]), by_hand()
    late = np.interp(TIME - 0.0253, np.arange(301) * DT, by_hand(every=1)[:, 3])
    np.testing.assert_allclose(found[:, :3], plain[:, :3], atol=1e-12)
    np.testing.assert_allclose(found[3:, 3], late[3:], atol=1e-12)
    assert np.abs(plain[4:, 3] - late[4:]).max() > 0.3


def test_a_fast_clock_stretches_the_recording(tmp_path):
    """A clock at 1.03 times true time stamps what happened at t / 1.03 with t, commands too."""
    found = simulated(tmp_path, "ClockSkew", {"ratio": 1.03})
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.timestep = 1e-4
    data, rows, times = mujoco.MjData(model), [], []
    data.qpos[:], data.qvel[:] = START
    while not times or times[-1] < TIME[-1]:
        times.append(data.time)
        rows.append([data.qpos[0], data.qvel[0], data.qpos[1], data.qvel[1]])
        data.ctrl[:] = CTRL[min(int(data.time * 1.03 / 0.01 + 1e-9), len(CTRL) - 1)]
        mujoco.mj_step(model, data)
    expected = np.stack([np.interp(TIME / 1.03, times, x) for x in np.array(rows).T], 1)
    unskewed = np.abs(by_hand() - expected).max()
    assert np.abs(found - expected).max() < 0.25 * unskewed  # measured: what is left is the coarser timestep


@pytest.mark.parametrize("form", FORMS)
def test_an_absent_effect_changes_nothing(tmp_path, form):
    own = dict(VALUES[form])
    for p in FORMS[form].unknown:
        if p.name not in ("cycles", "frequency", "phase", "rest") and (
            p.unit != ("m/s", "rad/s") or np.isinf(p.absent)
        ):
            own[p.name] = p.absent if p.size == 1 else [p.absent] * p.size
    if form == "PayloadMass":
        own["offset"] = VALUES[form]["offset"]
    np.testing.assert_allclose(
        simulated(tmp_path, form, own), by_hand(xml=LAWS.get(form, {}).get("xml", XML)), rtol=0, atol=1e-10
    )


BLOCK = '<body name="block"><joint name="run" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>'
PUSHED = '<actuator><motor name="pull" joint="run"/></actuator>'


def block(form, values, qvel, u, gravity="0 0 -9.81"):
    """Speeds and positions of a block under a constant command, 1 s."""
    xml = model_xml(BLOCK, PUSHED, option=f'<option timestep="0.001" gravity="{gravity}"/>')
    model = mujoco.MjModel.from_xml_string(xml)
    element = Element("joint", "run", False, 0, 0, 1, actuators=(0,), traits=frozenset({"driven"}))
    time = np.linspace(0, 1, 51)
    segments = cut([blank_recording(model, time, ["qpos/run", "qvel/run"], np.full((51, 1), u))])
    start = Start(np.zeros((1, 1)), np.array([[qvel]]), np.zeros((1, 0)))
    rows = EffectRows.alike(PlacedEffect(FORMS[form], element, Typical()), 1, values)
    return MujocoC(model, 1).rollout(Request(segments, np.zeros(1, int), start, {}, (rows,)))[0]


def test_static_friction_holds_what_sliding_friction_does_not():
    values = {"coulomb": 0.5, "static": 2.0, "velocity": 0.05}
    held, slid = block("StribeckFriction", values, 0.0, 1.5), block("StribeckFriction", values, 1.0, 1.5)
    assert np.abs(held).max() < 2e-3  # measured: MuJoCo's soft constraint creeps
    np.testing.assert_allclose(slid[:, 1], 1 + 0.5 * np.linspace(0, 1, 51), atol=5e-3)  # (1.5 - 0.5) N / 2 kg
    assert block("StribeckFriction", values, 0.0, 2.5)[-1, 1] > 0.5


def test_friction_by_load_takes_a_share_and_holds_at_rest():
    moved = block("LoadDependentFriction", {"coefficient": 0.25}, 0.0, 4.0)
    assert moved[-1, 1] == pytest.approx(4.0 * 0.75 / 2, rel=5e-3)
    # Gravity along the joint: a command that balances it, and more friction than the imbalance.
    held = block("LoadDependentFriction", {"coefficient": 0.25}, 0.0, 19.0, gravity="-9.81 0 0")
    assert np.abs(held).max() < 5e-3


BALL = '<body name="ball" pos="0 0 1"><joint name="hinge" axis="0 1 0"/><geom size="0.1" mass="2"/></body>'


@pytest.mark.parametrize("form", ["ComOffset", "PayloadMass"])
def test_a_body_whose_frames_are_one_can_be_changed(tmp_path, form):
    """MuJoCo's shortcuts for such a body (body_sameframe, body_simple) would ignore a changed inertial frame."""
    xml, time = model_xml(BALL), np.arange(21) * 0.02
    assert mujoco.MjModel.from_xml_string(xml).body_sameframe[1]
    simulator = Simulator(make_study(tmp_path / "ball", xml), num_threads=1)
    (body,) = simulator.elements("body", ("qpos/hinge",))
    placed = place_form(simulator.model, form)
    assert placed.effect.fits(body)  # so that it is a candidate
    segments = cut([blank_recording(simulator.model, time)])
    start = Start(np.full((1, 1), 0.3), np.ones((1, 1)), np.zeros((1, 0)))
    fields = simulator.fields(np.zeros((1, 0)), [""])
    effects = (EffectRows.alike(placed, 1, VALUES[form]),)
    found = simulator.rollout(Request(segments, np.zeros(1, int), start, fields, effects))[0]
    offset, mass, inertia = np.array(VALUES[form]["offset"]), 2.0, np.full(3, 0.4 * 2 * 0.1**2)
    about = inertia[1] + (mass * (offset[0] ** 2 + offset[2] ** 2) if form == "ComOffset" else 0.0)
    moment = mass * offset if form == "ComOffset" else VALUES[form]["mass"] * offset
    if form == "PayloadMass":
        about += VALUES[form]["mass"] * (offset[0] ** 2 + offset[2] ** 2)
    q, v = 0.3, 1.0
    expected = [(q, v)]
    for _ in range(200):  # a physical pendulum by semi-implicit Euler: torque of gravity about y over the inertia
        v += 0.002 * 9.81 * (moment[0] * np.cos(q) + moment[2] * np.sin(q)) / about
        q += 0.002 * v
        expected.append((q, v))
    np.testing.assert_allclose(found, np.array(expected)[::10], atol=1e-9)


def test_special_cases_are_simpler_effects_of_the_catalogue():
    """By their names, with values for all that they have, which are a law's own where that comes to them."""
    found = {}
    for name, effect in CATALOGUE.items():
        values = {p.name: np.full(p.size, 0.3) if p.size > 1 else 0.3 for p in effect.parameters}
        for other, near in effect.special_cases(values).items():
            assert CATALOGUE[other].size < effect.size and CATALOGUE[other].kind == effect.kind
            assert set(near) == {p.name for p in CATALOGUE[other].parameters}
            found[name] = other
    assert found == {"stribeck_friction": "coulomb_friction"}


def test_a_payload_may_be_as_heavy_as_what_carries_it():
    z = CATALOGUE["payload_mass"].to_normal({"mass": 0.2, "offset": np.zeros(3)}, Typical(inertia=0.2))
    assert z[0] == pytest.approx(2.0)  # prior sds


def test_a_payload_turns_equal_moments_no_further_than_it_must():
    """Of a sphere's axes any two across the payload would do; they stay where they are as it moves by a hair."""
    effect, at = CATALOGUE["payload_mass"], Element("body", "ball", body=1)
    still = {
        "body_mass": np.array([[0.0, 0.12]] * 2),
        "body_ipos": np.zeros((2, 2, 3)),
        "body_inertia": np.full((2, 2, 3), 1e-3),
        "body_iquat": np.broadcast_to([1.0, 0, 0, 0], (2, 2, 4)),
    }
    near = np.array([[0.1, 0.02, -0.03], [0.1, 0.02, -0.03 + 1e-7]])
    found = effect.fields({"mass": np.full(2, 2e-3), "offset": near}, still, at, np)
    first, second = found["body_iquat"][:, 1]
    assert 1 - abs(first @ second) < 1e-6
    np.testing.assert_allclose(*found["body_inertia"][:, 1], rtol=1e-5)
