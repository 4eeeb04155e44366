"""What MJX refuses, and how its programs are shared; its motion is tested in test_agreement."""

import subprocess
import sys

import jax
import mujoco
import numpy as np
import pytest
from conftest import ARM, HINGE, MOTORS, SLIDE, blank_recording

from det2stoc_bayes.engines import mjx as module
from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.engines.elements import joint_elements
from det2stoc_bayes.engines.mjx import Mjx
from det2stoc_bayes.engines.mjx_support import check_effect, check_fields, check_supported
from det2stoc_bayes.engines.mujoco_c import MujocoC
from det2stoc_bayes.errors import EngineError
from det2stoc_bayes.mismatch.effects import CATALOGUE, PlacedEffect, Typical
from det2stoc_bayes.segments import cut

SPHERES = """
<body name="low"><joint name="j" type="slide" axis="0 0 1"/>
  <geom name="a" type="{0}" size="0.1 0.1 0.1"/></body>
<body name="high" pos="0 0 1"><freejoint/><geom name="b" type="{1}" size="0.1 0.1 0.1"/></body>"""
MOTOR = '<actuator><motor name="turn" joint="hinge" {0}/></actuator>'
GENERAL = '<actuator><general name="turn" joint="hinge" {0}/></actuator>'
TENDON = '<tendon><fixed name="cord" {0}><joint joint="hinge" coef="1"/></fixed></tendon>'
SENSOR = "<sensor><{0}/></sensor>"
OPTION = "<option {0}/>"
FLAG = "<option><flag {0}/></option>"

REFUSED = [
    # bodies, rest, option, words that the message has
    (HINGE, "", OPTION.format('integrator="implicit"'), ["integrator=implicit", "Euler"]),
    (HINGE, "", OPTION.format('integrator="discrete"'), ["integrator=discrete", "RK4"]),
    (HINGE, "", OPTION.format('solver="PGS"'), ["solver=PGS", "Newton"]),
    (HINGE, "", OPTION.format('noslip_iterations="3"'), ["noslip_iterations=3"]),
    (HINGE, "", OPTION.format('integrator="implicitfast" density="1.2"'), ["density", "implicitfast"]),
    (HINGE, "", FLAG.format('spring="disable"'), ["flag spring=disable"]),
    (HINGE, "", FLAG.format('sleep="enable"'), ["flag sleep=enable"]),
    (HINGE, "", FLAG.format('energy="enable"'), ["ENERGY"]),
    (HINGE, MOTOR.format('group="2"'), OPTION.format('actuatorgroupdisable="2"'), ["actuator turn", "group"]),
    (HINGE.replace('damping="0.05"', 'damping="0.05 0.1"'), "", "", ["joint hinge", "polynomial damping"]),
    (HINGE.replace('damping="0.05"', 'stiffness="1 2"'), "", "", ["joint hinge", "polynomial stiffness"]),
    (HINGE, TENDON.format('damping="0.1 0.2"'), "", ["tendon cord", "polynomial damping"]),
    (HINGE, TENDON.format('stiffness="0.1 0.2"'), "", ["tendon cord", "polynomial stiffness"]),
    (HINGE.replace("<geom", '<geom name="rod" fluidshape="ellipsoid"'), "", "", ["geom rod", "ellipsoid"]),
    (HINGE, MOTOR.format('armature="0.1"'), "", ["actuator turn", "armature"]),
    (HINGE, MOTOR.format('damping="0.1"'), "", ["actuator turn", "damping"]),
    (HINGE, MOTOR.format('delay="0.01" nsample="10"'), "", ["actuator turn", "delay"]),
    (
        HINGE,
        GENERAL.format('dyntype="filter" dynprm="0.1" actearly="true"'),
        "",
        ["actuator turn", "actearly"],
    ),
    (HINGE, GENERAL.format('dyntype="user" actdim="1"'), "", ["actuator turn", "dynamics user"]),
    (HINGE, GENERAL.format('gaintype="user"'), "", ["actuator turn", "gain user"]),
    (HINGE, GENERAL.format('biastype="user"'), "", ["actuator turn", "bias user"]),
    (
        HINGE,
        '<actuator><adhesion name="glue" body="arm" ctrlrange="0 1" gain="1"/></actuator>',
        "",
        ["actuator glue", "body"],
    ),
    (SPHERES.format("cylinder", "box"), "", "", ["geoms a (cylinder) and b (box)", "mesh"]),
    (
        SPHERES.format("sphere", "box"),
        "",
        OPTION.format('cone="elliptic"'),
        ["a (sphere) and b (box)", "pyramidal"],
    ),
    (
        SPHERES.format("sphere", "sphere").replace('name="b"', 'name="b" adhesion="1"'),
        "",
        "",
        ["geom b", "adhesion"],
    ),
    (
        SPHERES.format("sphere", "sphere").replace('name="b"', 'name="b" surfacevel="1 0 0 0 0 0"'),
        "",
        "",
        ["geom b", "surface"],
    ),
    (
        HINGE.replace("damping", 'range="-1 1" limited="true" damping'),
        SENSOR.format('jointlimitpos name="end" joint="hinge"'),
        "",
        ["sensor end", "jointlimitpos"],
    ),
    (
        HINGE,
        '<custom><numeric name="max_contact_points" data="3"/></custom>',
        "",
        ["numeric max_contact_points"],
    ),
    (HINGE, SENSOR.format('e_kinetic name="heat"'), "", ["sensor heat", "e_kinetic"]),
    (
        HINGE,
        SENSOR.format('jointpos name="late" joint="hinge" delay="0.01" nsample="10"'),
        "",
        ["sensor late", "delay"],
    ),
]


@pytest.mark.parametrize(("bodies", "rest", "option", "words"), REFUSED, ids=[" ".join(r[3]) for r in REFUSED])
def test_refuses_what_it_would_drop(compiled, bodies, rest, option, words):
    model = compiled(bodies, rest, option=option)
    with pytest.raises(EngineError) as caught:
        check_supported(model)
    message = str(caught.value)
    assert all(word in message for word in [*words, "mjx: ", "allowed: "]) and "\n" not in message


def test_refuses_fields_and_effects_without_a_way_in(compiled):
    model = compiled(HINGE, TENDON.format(""))
    for field in ("dof_dampingpoly", "geom_fluid", "opt.timestep", "actuator_delay"):
        with pytest.raises(EngineError, match=field):
            check_fields(model, [field])
    with pytest.raises(EngineError, match=r"body_pos.*tendons"):
        check_fields(model, ["body_pos"])
    check_fields(compiled(HINGE), ["body_pos", "dof_damping", "opt.gravity"])

    class Unheard(type(CATALOGUE["viscous_damping"])):
        in_mjx_fields = False

    with pytest.raises(EngineError, match="viscous_damping on joint hinge"):
        check_effect(model, PlacedEffect(Unheard(), joint_elements(model)[0], Typical()))


def request(model, rows, effects=(), num_samples=6, **fields):
    """Simulations from starts of their own."""
    time, rng = np.arange(num_samples) * 0.01, np.random.default_rng(0)
    start = Start(
        rng.standard_normal((rows, model.nq)),
        rng.standard_normal((rows, model.nv)),
        np.zeros((rows, model.na)),
    )
    return Request(cut([blank_recording(model, time)]), np.zeros(rows, int), start, fields, tuple(effects))


def test_rows_with_their_own_effects_in_chunks(compiled, monkeypatch):
    model, rng = compiled(SLIDE), np.random.default_rng(0)
    monkeypatch.setattr(module, "MAX_CHUNK", {"cpu": 4})
    element = joint_elements(model)[0]
    push, spring = (PlacedEffect(CATALOGUE[n], element, Typical()) for n in ("constant_force", "cubic_stiffness"))
    effects = [
        EffectRows(push, slice(0, 5), {"force": rng.standard_normal(5)}),
        EffectRows(spring, slice(3, 7), {"stiffness": 50 * rng.random(4)}),
    ]
    engine = Mjx(model)
    asked = request(model, 9, effects, dof_damping=rng.random((9, 1)))
    out = engine.trajectory(asked)
    expected = MujocoC(model).trajectory(asked)
    np.testing.assert_allclose(out.columns, expected.columns, atol=1e-10)
    np.testing.assert_allclose(out.qvel, expected.qvel, atol=1e-10)
    assert (engine.counter.simulations, engine.counter.steps) == (9, 9 * 25)
    assert len(engine._compiled) == 4  # none, push, both, spring
    # A diverging simulation is alone.
    damping = np.where(np.arange(9)[:, None] == 7, -1e9, 0.1)
    out = engine.rollout(request(model, 9, effects, dof_damping=damping))
    assert np.isnan(out).all((1, 2)).tolist() == [k == 7 for k in range(9)]
    assert len(engine._compiled) == 4


def test_construction_is_quiet_and_in_double_precision(compiled):
    Mjx(compiled(ARM, MOTORS))
    assert jax.config.jax_enable_x64
    code = "import det2stoc_bayes.engines.mjx, jax; print(jax.config.jax_enable_x64)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("False\n", "")


def test_options_of_a_request(compiled):
    model = compiled(SLIDE)
    asked = request(model, 1)
    changed = Request(asked.segments, asked.which, asked.start, {}, (), 0.001, "implicitfast")
    np.testing.assert_allclose(Mjx(model).rollout(changed), MujocoC(model).rollout(changed), atol=1e-10)
    with pytest.raises(EngineError, match="integrator=implicit "):
        Mjx(model).rollout(Request(asked.segments, asked.which, asked.start, {}, (), None, "implicit"))


def test_warnings_of_mujoco_are_not_left_off(compiled):
    MujocoC(compiled(HINGE)).rollout(request(compiled(HINGE), 1))
    assert mujoco.MjLogConfig.get().logto_console
