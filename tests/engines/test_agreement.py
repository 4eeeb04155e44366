"""Both engines on the same requests, and the derivatives of one against differences of the other."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from catalogue import AIR, FORMS, VALUES, place_form
from conftest import (
    ARM,
    CARTPOLE,
    FREE,
    GENERAL,
    HINGE,
    MOTORS,
    SLIDE,
    blank_recording,
    make_study,
    model_xml,
    state_columns,
)

from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.engines.mjx import Mjx
from det2stoc_bayes.engines.mujoco_c import MujocoC
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.segments import cut
from det2stoc_bayes.simulator import Simulator

TIME = np.arange(41) * 0.025  # 500 steps


def agree(model, fields, effects_c=(), effects_mjx=None, num_sims=2, tolerance=1e-6, columns=None, time=TIME):
    """Both engines' values on the same starts and commands, compared relative to each column's size."""
    rng = np.random.default_rng(0)
    ctrl = 0.5 * np.sin(np.outer(time, 2 + np.arange(model.nu)))
    segments = cut([blank_recording(model, time, columns, ctrl)])
    qpos = model.qpos0 + (0.2 if model.nq == model.nv else 0.0)
    start = Start(
        np.tile(qpos, (num_sims, 1)),
        np.tile(rng.standard_normal(model.nv), (num_sims, 1)),
        np.zeros((num_sims, model.na)),
    )
    request = [
        Request(segments, np.zeros(num_sims, int), start, fields, e) for e in (effects_c, effects_mjx or effects_c)
    ]
    c, mjx = MujocoC(model).rollout(request[0]), Mjx(model).rollout(request[1])
    scale = np.abs(c).max((0, 1)) + 1e-3
    assert np.isfinite(c).all()
    assert (np.abs(c - mjx) / scale).max((1, 2)) == pytest.approx(np.zeros(num_sims), abs=tolerance)
    return c


ZOO = HINGE + SLIDE + CARTPOLE + ARM + FREE
CHANGES = {
    "body_ipos": {"arm": [0.1, 0.05, -0.2]},
    "jnt_stiffness": {"slide": 50.0},
    "qpos_spring": {"slide": -0.2},
    "body_mass": {"block": 2.0, "cart": 2.0, "pole": 0.5},
    "dof_damping": {"hinge": -0.1, "pivot": 0.0},
    "body_inertia": {"lower": [0.01, 0.02, 0.025], "stone": [2e-3, 5e-3, 6e-3]},
    "actuator_biasprm": {"turn": [0.5, -2, -0.2]},
    "actuator_dynprm": {"servo": [0.2]},
    "actuator_gear": {"turn": [3.0]},
    "dof_armature": {"shoulder": 0.1, "elbow": 0.05},
}
KINDS = {"body": "body", "jnt": "joint", "dof": "joint", "qpos": "joint", "actuator": "actuator"}


@pytest.mark.parametrize(
    ("bodies", "rest", "integrator"),
    [(ZOO, GENERAL, "Euler"), (ARM, MOTORS, "implicitfast"), pytest.param(HINGE, "", "RK4", marks=pytest.mark.long)],
    ids=["euler", "implicitfast", "rk4"],
)
def test_same_motion(compiled, bodies, rest, integrator):
    model = compiled(bodies, rest, integrator)
    fields = {"opt.gravity": np.array([model.opt.gravity, [1.0, 0, -5]])}
    for name, edits in CHANGES.items():
        base, kind = np.array(getattr(model, name), float), KINDS[name.split("_")[0]]
        edited = base.copy()
        for element, value in edits.items():
            if f'name="{element}"' in bodies + rest:
                named = getattr(model, kind)(element)
                row = {"dof": "dofadr", "qpos": "qposadr"}.get(name.split("_")[0])
                place = int(getattr(named, row)[0]) if row else named.id
                edited[place, ...] = (
                    np.resize(np.append(value, np.zeros(9)), base.shape[1:]) if base.ndim > 1 else value
                )
        if (edited != base).any():
            fields[name] = np.stack([base, edited])
    c = agree(model, fields)
    moved = np.abs(c[0] - c[1]).max(0)
    assert (moved[:-13] > 1e-3).all() if "stone" in bodies else (moved > 1e-3).all()


# What has a weight derived from inertias (friction, limits), or is left out of MJX's program at 0.
DERIVED = {
    "dof_frictionloss": [0.05, 0.08],
    "body_mass": [0, 2.0, 1.0],
    "body_inertia": 3 * [[0.02, 0.02, 0.03]],
    "dof_armature": [0.2, 0.1],
    "actuator_gear": [[3.0, 0, 0, 0, 0, 0], [2, 0, 0, 0, 0, 0]],
    "body_gravcomp": [0, 0.5, 0.8],
    "opt.density": 300.0,
    "body_ipos": [[0, 0, 0], [0.1, 0, 0.1], [0, 0.1, 0]],
}


def test_same_motion_with_every_effect_and_derived_constant(compiled):
    bodies = ARM.replace('name="elbow"', 'name="elbow" range="-15 15" limited="true"')
    bodies = bodies.replace('name="shoulder"', 'name="shoulder" frictionloss="0.1"')
    sensors = '<subtreelinvel name="flow" body="upper"/><actuatorfrc name="effort" actuator="servo"/>'
    sensors += '<framelinacc name="acc" objtype="body" objname="lower"/>'
    model = compiled(bodies, MOTORS + f"<sensor>{sensors}</sensor>", option=AIR.format("Euler"))
    effects = [(place_form(model, form), VALUES[form]) for form in FORMS if form != "PayloadMass"]
    rows = len(DERIVED) + len(effects) + 1
    fields = {}
    for k, (name, value) in enumerate(DERIVED.items()):
        base = np.array(model.opt.density if name == "opt.density" else getattr(model, name), float)
        fields[name] = np.stack([base] * rows)
        fields[name][k] = np.reshape(value, base.shape)
    # The C engine runs each effect alone; MJX one program with all, of which one at a time is present.
    alone, together = [], []
    for k, (placed, values) in enumerate(effects, len(DERIVED)):
        alone.append(EffectRows(placed, slice(k, k + 1), {n: np.array([v]) for n, v in values.items()}))
        absent = {p.name: p.absent if p.size == 1 else [p.absent] * p.size for p in placed.effect.parameters}
        absent |= {p.name: values[p.name] for p in placed.effect.parameters if p.given}
        absent |= {n: values[n] for n in ("velocity", "cycles", "frequency") if n in values and np.ndim(values[n]) == 0}
        present = [values if row == k else absent for row in range(rows)]
        together.append(EffectRows(placed, slice(0, rows), {n: np.array([v[n] for v in present]) for n in values}))
    columns = [*state_columns(model), "sensor/flow/0", "sensor/flow/2", "sensor/effort"]
    columns += ["sensor/acc/0", "sensor/acc/2"]
    time = TIME + np.where(np.arange(len(TIME)) % 3, 0.0, 0.0007)  # every third sample between two steps
    c = agree(model, fields, tuple(alone), tuple(together), rows, columns=columns, time=time)
    names = [*DERIVED, *(placed.label for placed, _ in effects)]
    unmoved = [n for n, change in zip(names, np.abs(c[:-1] - c[-1]).max((1, 2)), strict=True) if change < 1e-3]
    assert unmoved == []


def test_derivatives(tmp_path):
    toml = """
[psi.mass]
target = "body/lower/mass"
prior = { Normal = { loc = 0.6, scale = 0.1 } }
[psi.loss]
target = "joint/elbow/frictionloss"
prior = { HalfNormal = { scale = 0.1 } }
[psi.down]
target = "opt/gravity"
index = [2]
prior = { Normal = { loc = -9.8, scale = 0.1 } }
"""
    xml = model_xml(ARM, MOTORS)
    time = np.arange(26) * 0.01
    series = {
        c: 0.3 + 0.1 * np.sin(5 * time + i) for i, c in enumerate(state_columns(mujoco.MjModel.from_xml_string(xml)))
    }
    series |= {"ctrl/turn": np.sin(9 * time), "ctrl/servo": 0.5 * np.cos(7 * time)}
    study = make_study(tmp_path / "s", xml, toml, {"one": (time, series)})
    c, mjx = Simulator(study), Simulator(study, "mjx")
    chosen = ("QuadraticDamping", "QuadraticDrag", "ActuatorDelay", "SensorBias", "StribeckFriction")
    chosen += ("GravityTilt", "ComOffset", "ActuatorLag", "PeriodicForce", "ClockSkew")
    effects = [place_form(c.model, form) for form in chosen]
    values = [p.effect.to_normal(VALUES[form], p.typical) for form, p in zip(chosen, effects, strict=True)]
    problem, other = (make_problem(s, num_samples=13).with_effects(effects) for s in (c, mjx))
    z = np.concatenate([[0.3, 0.5, -0.2], *values])
    start, states = problem.guess.start, 2 * c.model.nv
    predict = mjx.engine.predict_fn(other, start)

    def moved(x):  # the same change for every segment
        return predict(x[: len(z)], jnp.tile(x[len(z) :], (problem.segments.count, 1)))

    x = np.concatenate([z, np.zeros(states)])
    # Values and derivatives from one program.
    values, jacobian = jax.jit(jax.jacfwd(lambda x: (moved(x),) * 2, has_aux=True))(x)[::-1]

    def run(x):
        change = np.tile(x[len(z) :], (problem.segments.count, 1))
        return c.rollout(problem.request(x[None, : len(z)], problem.moved(start, change)))

    np.testing.assert_allclose(values, run(x), rtol=0, atol=1e-8)
    # The arm moves in the plane of x and z.
    across = [name.endswith(".offset.y") for name in problem.names] + [False] * states
    assert sum(across) == 1
    for k in range(len(x)):
        step = 1e-5 * np.eye(len(x))[k]
        difference = (run(x + step) - run(x - step)) / 2e-5
        if across[k]:
            assert np.abs(difference).max() == np.abs(jacobian[..., k]).max() == 0
            continue
        assert np.abs(difference).max() > 1e-6
        assert np.abs(difference - jacobian[..., k]).max() < 1e-4 * np.abs(difference).max()


@pytest.mark.long
def test_derivatives_of_a_body_at_rest_are_finite(tmp_path):
    xml = model_xml(FREE)
    study = make_study(
        tmp_path / "s",
        xml,
        '[psi.mass]\ntarget = "body/stone/mass"\nprior = { Normal = { loc = 0.8 } }\n',
        {
            "one": (
                np.arange(4) * 0.004,
                {f"qpos/float/{p}": np.full(4, v) for p, v in {"z": 2, "qw": 1, "qx": 0, "qy": 0, "qz": 0}.items()},
            )
        },
    )
    simulator = Simulator(study, "mjx")
    problem = make_problem(simulator)
    predict = simulator.engine.predict_fn(problem, problem.guess.start)
    c, direction = Simulator(study), np.linspace(0.5, 1, 12)[None]

    @jax.jit
    def slope(direction):
        return jax.jvp(lambda change: predict(jnp.zeros(1), change), (jnp.zeros((1, 12)),), (direction,))[1]

    ends = [
        c.rollout(problem.request(np.zeros((1, 1)), problem.moved(problem.guess.start, s * direction)))
        for s in (1e-5, -1e-5)
    ]
    np.testing.assert_allclose(slope(direction), (ends[0] - ends[1]) / 2e-5, atol=1e-7)
