"""Effects of contact: both of their forms move alike in the engine and in a plain loop, and as physics has it."""

from dataclasses import replace
from types import ModuleType, SimpleNamespace

import mujoco
import numpy as np
import pytest
from conftest import blank_recording, make_study, state_columns

from det2stoc_bayes.engines import contacts
from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.mismatch.effects import CATALOGUE, PlacedEffect, Typical
from det2stoc_bayes.mismatch.patch import make_patch
from det2stoc_bayes.segments import cut
from det2stoc_bayes.simulator import Simulator

SCENE = """<mujoco>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" friction="0.3 0.005 0.0001"/>
    <geom name="wall" type="box" size="0.1 2 0.5" pos="3 0 0.5"/>
    <body name="box" pos="0 0 0.0999">
      <freejoint name="move"/>
      <geom name="hull" type="box" size="0.1 0.1 0.1" mass="1" friction="0.3 0.005 0.0001"/>
    </body>
  </worldbody>{}
</mujoco>
"""
PAIR = '<contact><pair name="both" geom1="floor" geom2="hull" friction="0.3 0.3 0.005 0.0001 0.0001"/></contact>'
VALUES = {
    "friction_error": {"ratio": 0.5},
    "rolling_friction": {"coefficient": 0.02},
    "torsional_friction": {"coefficient": 0.03},
    "contact_stiffness": {"time_constant": 0.05},
    "restitution_error": {"damping_ratio": 0.2},
    "adhesion": {"force": 2.0},
    "viscous_contact_friction": {"coefficient": 2.0},
    "anisotropic_friction": {"ratio": 0.3, "direction": 0.4},
    "friction_patch": {"ratio": 0.3, "point": [0.25, 0.0, 0.0], "normal": [1.0, 0.0, 0.0]},
}
TIME = np.arange(41) * 0.01
# Falls a little, slides and turns.
START = Start(np.array([[0.0, 0, 0.12, 1, 0, 0, 0]]), np.array([[2.0, 0.3, 0, 0, 0, 3.0]]), np.zeros((1, 0)))


def load(text):
    """The module of a text."""
    module = ModuleType("effects")
    exec(compile(text, "effects.py", "exec"), module.__dict__)
    return module


def scene(tmp_path, extra="", half=0.1, gravity="0 0 -9.81"):
    """The box is so high, m."""
    low = SCENE.replace("0.0999", f"{half - 1e-4}").replace("0.1 0.1 0.1", f"0.1 0.1 {half}")
    low = low.replace("timestep", f'gravity="{gravity}" timestep')
    study = make_study(tmp_path / "study", low.format(extra))
    simulator = Simulator(study, num_threads=1)
    segments = cut([blank_recording(simulator.model, TIME)])
    pairs, _ = contacts.touching(simulator.model, START.qpos * [1, 1, 0, 1, 1, 1, 1] + np.eye(7)[2] * (half - 1e-4))
    (at,) = contacts.contact_elements(simulator.model, pairs)
    return study, simulator, segments, at


def rollout(simulator, segments, effects=(), start=START):
    rows = tuple(EffectRows.alike(p, 1, v) for p, v in effects)
    request = Request(segments, np.zeros(1, int), start, simulator.fields(np.zeros((1, 0)), ["blank"]), rows)
    return simulator.rollout(request)[0]


def place(name, at):
    effect = [f for f in CATALOGUE[name].forms() if f.fits(at)][-1]
    return PlacedEffect(effect, at, Typical())


@pytest.mark.parametrize("extra", ["", PAIR], ids=["geoms", "pair"])
@pytest.mark.parametrize("name", VALUES)
def test_engine_and_patched_simulator_move_alike(tmp_path, name, extra):
    study, simulator, segments, at = scene(tmp_path, extra)
    assert at.name == "floor/hull" and (at.pair >= 0) == bool(extra)
    placed, values = place(name, at), VALUES[name]
    predicted = rollout(simulator, segments, [(placed, values)])
    patch = make_patch(study, {}, [(placed, values)])
    model = mujoco.MjModel.from_xml_string(patch.model)
    data, effects = mujoco.MjData(model), load(patch.module) if patch.module else None
    data.qpos[:], data.qvel[:] = START.qpos[0], START.qvel[0]
    if effects:
        effects.reset(model, data)
    out = []
    for _ in TIME:
        out.append(np.concatenate([data.qpos, data.qvel]))
        for _ in range(5):
            data.qfrc_applied[:], data.xfrc_applied[:] = 0.0, 0.0
            if effects:
                effects.control(model, data)
            mujoco.mj_step(model, data)
    # measured: below 1e-9
    np.testing.assert_allclose(predicted, np.array(out), atol=1e-6)
    changed = np.abs(predicted - rollout(simulator, segments)).max()
    assert changed > 1e-3, changed


def test_a_ratio_of_friction_scales_the_deceleration(tmp_path):
    _, simulator, segments, at = scene(tmp_path)
    start = replace(START, qpos=np.array([[0.0, 0, 0.1, 1, 0, 0, 0]]), qvel=np.array([[2.0, 0, 0, 0, 0, 0]]))
    speed = list(segments.columns).index("qvel/move/vx")
    slow = [
        -np.diff(rollout(simulator, segments, e, start)[[15, 40], speed])[0] / 0.25
        for e in ((), [(place("friction_error", at), {"ratio": 0.5})])
    ]
    # measured: 0.957 and 1.026 of Coulomb's, since the box still rocks a little
    assert slow[0] == pytest.approx(0.3 * 9.81, rel=0.06)
    assert slow[1] == pytest.approx(0.15 * 9.81, rel=0.06)


@pytest.mark.parametrize(("force", "stays"), [(2.0, True), (0.5, False)])
def test_what_sticks_does_not_slide_where_its_corners_press_enough(tmp_path, force, stays):
    """A pull of 4 N along the ground, on 1 kg by friction of 0.3: held from 0.88 N a corner on."""
    _, simulator, segments, at = scene(tmp_path, half=0.01, gravity="4 0 -9.81")
    start = replace(START, qpos=np.array([[0.0, 0, 0.01, 1, 0, 0, 0]]), qvel=np.zeros((1, 6)))
    way = rollout(simulator, segments, [(place("adhesion", at), {"force": force})], start)[-1, 0]
    assert way < 0.01 if stays else way > 0.02, way


def test_what_rubs_by_speed_slows_in_proportion(tmp_path):
    """By c v, beside dry friction; of 1 kg that slides, too low to rock."""
    _, simulator, segments, at = scene(tmp_path, half=0.01)
    start = replace(START, qpos=np.array([[0.0, 0, 0.01, 1, 0, 0, 0]]), qvel=np.array([[2.0, 0, 0, 0, 0, 0]]))
    speed = list(segments.columns).index("qvel/move/vx")
    effects = (), [(place("viscous_contact_friction", at), {"coefficient": 2.0})]
    plain, rubbed = (rollout(simulator, segments, e, start)[10:, speed] for e in effects)
    extra = (np.diff(plain[[0, -1]]) - np.diff(rubbed[[0, -1]]))[0] / 0.3
    assert extra == pytest.approx(2.0 * rubbed.mean(), rel=0.1)


@pytest.mark.parametrize(("turn", "ratio"), [(0.0, 0.5), (np.pi / 2, 1.0), (np.pi / 4, np.sqrt(0.625))])
def test_friction_is_that_of_an_ellipse_in_the_direction_of_the_motion(tmp_path, turn, ratio):
    """Half as much along the way, or across it, or at half a right angle to it."""
    _, simulator, segments, at = scene(tmp_path, half=0.01)
    start = replace(START, qpos=np.array([[0.0, 0, 0.01, 1, 0, 0, 0]]), qvel=np.array([[2.0, 0, 0, 0, 0, 0]]))
    speed = list(segments.columns).index("qvel/move/vx")
    effects = (), [(place("anisotropic_friction", at), {"ratio": 0.5, "direction": turn})]
    plain, other = (-np.diff(rollout(simulator, segments, e, start)[[10, 40], speed])[0] for e in effects)
    assert other / plain == pytest.approx(ratio, rel=0.02)


def test_a_direction_is_where_two_trials_add_up(tmp_path):
    """Of a small ratio the friction along any direction is the mixture that `combine` names, and a part of friction."""
    _, _, _, at = scene(tmp_path)
    effect = place("anisotropic_friction", at).effect
    (trial,) = effect.trials(Typical())
    ways = np.linspace(0, np.pi, 9)
    speeds = np.stack([np.cos(ways), np.sin(ways), 0 * ways], -1)

    def change(p):
        moment = effect.moment(p, {}, SimpleNamespace(v=speeds), None, np)
        friction = effect.changed({**p, "moment": moment}, np.ones((9, 3)), None, None, np)[0]
        return friction[:, 0] - 1

    columns = np.stack([*(change({n: np.full(9, v) for n, v in c.items()}) for c in trial.columns), np.ones(9)], 1)
    wanted = change({"ratio": np.full(9, 1.02), "direction": np.full(9, 1.2)})
    found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    assert effect.combine(trial, found[:2], Typical()) == pytest.approx({"ratio": 1.02, "direction": 1.2}, abs=0.01)


def test_an_adhesion_that_is_psi_acts_though_the_model_has_none(tmp_path):
    """MuJoCo looks at adhesions where the compiled model has some."""
    _, simulator, segments, _ = scene(tmp_path)
    fields = simulator.fields(np.zeros((1, 0)), ["blank"])
    sticky = np.array(simulator.model.geom_adhesion, float)[None]
    sticky[0, simulator.model.geom("hull").id] = 5.0
    plain, stuck = (
        simulator.rollout(Request(segments, np.zeros(1, int), START, f))
        for f in (fields, {**fields, "geom_adhesion": sticky})
    )
    assert np.abs(plain - stuck).max() > 1e-2


def frictions(model):
    """Sliding friction by what the box touches, where it stands on the floor and leans against the wall."""
    data = mujoco.MjData(model)
    data.qpos[:3] = 2.8001, 0.0, 0.0999
    mujoco.mj_forward(model, data)
    hull = model.geom("hull").id
    return {model.geom(sum(c.geom) - hull).name: c.friction[0] for c in data.contact if hull in c.geom}


def test_other_contacts_of_a_geom_keep_their_friction(tmp_path):
    _, simulator, _, at = scene(tmp_path)
    model = simulator.model
    placed = place("friction_error", at)
    before = frictions(model)
    assert before == {"floor": 0.3, "wall": 1.0}
    fields = {n: np.array(getattr(model, n), float)[None] for n in placed.effect.changes}
    for name, values in placed.effect.fields({"ratio": np.array([0.5])}, fields, at, np).items():
        getattr(model, name)[:] = values[0]
    assert frictions(model) == pytest.approx(before | {"floor": 0.15})


def test_contacts_are_named_in_alphabetical_order_and_the_still_geom_is_changed(tmp_path):
    _, simulator, _, at = scene(tmp_path)
    model = simulator.model
    assert at.geoms == (model.geom("hull").id, model.geom("floor").id) and "free" in at.traits
    assert state_columns(model)[0] == "qpos/move/x"
