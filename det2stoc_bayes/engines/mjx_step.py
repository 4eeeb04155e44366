"""Single steps in MJX, with forces and model fields that depend on the state; as the C engine's."""

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from det2stoc_bayes.engines import drive
from det2stoc_bayes.engines.mjx_model import COMPILED, braking
from det2stoc_bayes.engines.places import bodies_of
from det2stoc_bayes.mismatch.effects.base import BodyState, JointState, PlacedEffect

with contextlib.redirect_stdout(io.StringIO()):  # it prints that warp is missing, which nothing here uses
    from mujoco import mjx as mjx
    from mujoco.mjx._src.forward import _integrate_pos  # it has no public name

SLOW_SPIN = 3e-8  # rad/s; MJX takes less than 1e-8 for no rotation at all, with no derivatives either
Parameters = Mapping[str, Any]
put_model = mjx.put_model


class Stepper:
    """Steps one simulation under effects."""

    def __init__(self, model: mujoco.MjModel, effects: Sequence[PlacedEffect], sensors: bool):
        self.dt, self.effects = float(model.opt.timestep), tuple(effects)
        self.data, self._kinds, self._sensors = mjx.make_data(model), model, sensors
        # As in the C engine: a force held over a step of RK4 is that of the middle of the step.
        self._lead = 0.5 * self.dt if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.0
        self._spins = [
            int(v) + {0: 3, 1: 0}[int(k)] for k, v in zip(model.jnt_type, model.jnt_dofadr, strict=True) if k < 2
        ]
        self._forced = [i for i, e in enumerate(effects) if not in_fields(e) and e.effect.uses("joint_force")]
        self._remembering = [i for i in self._forced if effects[i].effect.uses("anchor")]
        self._momentary = [i for i, e in enumerate(effects) if e.effect.writes]
        self._pushed = [i for i, e in enumerate(effects) if e.effect.uses("body_force")]

    def advance(self, model, parameters, state, u, share=1.0):
        """State after a share of a step; sensors before it.

        The state is qpos, qvel, act, warmstart, time, speeds one step ago and what effects remember.
        """
        data = self.data.replace(
            qpos=state[0],
            qvel=self._turning(state[1]),
            act=state[2],
            qacc_warmstart=state[3],
            time=state[4],
            ctrl=u,
        )
        lead = self._lead * share
        middle = data.qvel + 0.5 * share * (state[1] - state[5]) if self._lead else data.qvel
        anchors = self._anchors(data, parameters, middle, lead, state[6])
        after, sensors = self._step(model, data, parameters, middle, lead, anchors)
        # Time is the recorded clock's, whatever a step of it lasts.
        state = (after.qpos, after.qvel, after.act, after.qacc_warmstart, state[4] + self.dt * share, state[1], anchors)
        return state, sensors

    def first_anchors(self, qpos):
        """What effects with memory remember at a start."""
        return jnp.stack([qpos[self.effects[i].element.qpos] for i in self._remembering] or [jnp.zeros(())])

    def _anchors(self, d, parameters, middle, lead, past):
        """What they remember as a step begins."""
        found = [
            self.effects[i].effect.anchor(
                parameters[i], self._motion(d, self.effects[i].element, middle, lead)[0], a, jnp
            )
            for i, a in zip(self._remembering, past, strict=False)
        ]
        return jnp.stack(found) if found else past

    def _motion(self, d, at, middle, lead):
        return d.qpos[at.qpos] + lead * 0.5 * (d.qvel + middle)[at.dof], middle[at.dof]

    def _turning(self, qvel: Float[Array, " nv"]) -> Float[Array, " nv"]:
        for v in self._spins:
            spin = qvel[v : v + 3]
            qvel = qvel.at[v : v + 3].add(jnp.where(jnp.all(jnp.abs(spin) < SLOW_SPIN), SLOW_SPIN, 0.0))
        return qvel

    def _step(self, m, d, parameters, middle, lead, anchors):
        """As mj_step; effects' forces are held over the step, those that are damping in MuJoCo linearized.

        `middle`: speeds where the forces are taken, `lead` seconds on, as the last step's change foretells them.
        """
        m = self._now(m, d, parameters, middle, lead)
        d = mjx.fwd_position(m, d)
        d = mjx.sensor_pos(m, d) if self._sensors else d
        m, d = self._joint_forces(m, d, parameters, middle, lead, anchors)
        d = mjx.fwd_velocity(m, d)
        d = mjx.sensor_vel(m, d) if self._sensors else d
        d = self._body_forces(m, d, parameters, middle, lead)
        d = mjx.fwd_acceleration(m, mjx.fwd_actuation(m, d))
        d = mjx.solve(m, d) if d._impl.efc_J.size else d.replace(qacc=d.qacc_smooth)
        d = mjx.sensor_acc(m, d) if self._sensors else d
        return _integrate(m, d), d.sensordata

    def _now(self, m, d, parameters, middle, lead):
        """The model with the fields that effects rewrite at every step."""
        for i in self._momentary:
            effect, at = self.effects[i].effect, self.effects[i].element
            inside = {name: field_of(m, name) for name in (*effect.writes, *effect.reads)}
            changed = effect.momentary(parameters[i], inside, self._joint_state(m, d, at, middle, lead), at, jnp)
            changed = {name: value for name, value in changed.items() if name not in COMPILED}
            if "dof_frictionloss" in changed:
                there = m._impl.dof_hasfrictionloss
                changed["dof_frictionloss"] = braking(there, changed["dof_frictionloss"])
            m = m.tree_replace(changed)
        return m

    def _joint_state(self, m, d, at, middle, lead):
        time = d.time + lead
        if at.dof < 0:
            return JointState(0.0 * time, 0.0 * time, time)
        given = None
        if at.actuators:
            given = drive.drive_of(self._kinds, at, lambda name: field_of(m, name), d.ctrl, d.act, jnp)
        other = None
        if at.source:
            from_there = replace(at, qpos=at.source_qpos, dof=at.source_dof)
            other = JointState(*self._motion(d, from_there, middle, lead), time)
        return JointState(*self._motion(d, at, middle, lead), time, given, other)

    def _joint_forces(self, m, d, parameters, middle, lead, anchors):
        force, damping = d.qfrc_applied, m.dof_damping
        for i in self._forced:
            effect, at = self.effects[i].effect, self.effects[i].element
            # Where MuJoCo has it as damping, it follows the speed within a step by itself.
            v = d.qvel[at.dof] if effect.changes else middle[at.dof]
            state = self._joint_state(m, d, at, middle, lead)
            if i in self._remembering:
                state = replace(state, anchor=anchors[self._remembering.index(i)])
            law = partial(_joint_force, effect, parameters[i], state)
            value = law(v)
            if effect.changes:  # MuJoCo treats it as damping, implicitly: its slope joins the damping
                slope = jax.jvp(law, (v,), (jnp.ones_like(v),))[1]
                damping, value = damping.at[at.dof].add(-slope), value - slope * v
            force = force.at[at.dof].add(value)
            if at.source:
                force = force.at[at.source_dof].add(effect.reaction(parameters[i], state, jnp))
        return m.replace(dof_damping=damping), d.replace(qfrc_applied=force)

    def _body_forces(self, m, d, parameters, middle, lead):
        wrench, now = d.xfrc_applied, d
        if self._pushed and self._lead:
            way = 0.5 * (d.qvel + middle)
            now = d.replace(qpos=_integrate_pos(self._kinds.jnt_type, d.qpos, way, lead), qvel=middle)
            now = mjx.com_vel(m, mjx.com_pos(m, mjx.kinematics(m, now)))
        for i in self._pushed:
            effect = self.effects[i].effect
            for body in bodies_of(self._kinds, self.effects[i].element):
                state = self._body_state(m, now, body, d.time + lead)
                wrench = wrench.at[body, :3].add(effect.body_force(parameters[i], state, jnp))
                if effect.uses("body_torque"):
                    wrench = wrench.at[body, 3:].add(effect.body_torque(parameters[i], state, jnp))
        return d.replace(xfrc_applied=wrench)

    def _body_state(self, m, now, body, time):
        spin, lever = now.cvel[body, :3], now.xipos[body] - now.subtree_com[m.body_rootid[body]]
        geoms = np.flatnonzero(self._kinds.geom_bodyid == body)
        shapes = tuple(int(t) for t in self._kinds.geom_type[geoms])
        velocity, axes = now.cvel[body, 3:] + jnp.cross(spin, lever), now.ximat[body]
        inertia = (axes * m.body_inertia[body]) @ axes.T
        return BodyState(velocity, time, spin, shapes, m.geom_size[geoms], now.xipos[body], m.body_mass[body], inertia)


def in_fields(placed: PlacedEffect) -> bool:
    """Whether the effect enters MJX through model fields."""
    return bool(placed.effect.changes) and placed.effect.in_mjx_fields


def _integrate(m, d):
    integrator = m.opt.integrator
    if integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return mjx.rungekutta4(m, d)
    if integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        return mjx.implicit(m, d)
    # C integrates damping implicitly only if some of it is positive.
    damping = jnp.where(jnp.any(m.dof_damping > 0), m.dof_damping, 0.0)
    return mjx.euler(m.replace(dof_damping=damping), d)


def field_of(model, name: str):
    holder, _, leaf = name.rpartition(".")
    return getattr(model.opt if holder == "opt" else model, leaf)


def _joint_force(effect: Any, parameters: Any, state: JointState, v: Any) -> Any:
    return effect.joint_force(parameters, replace(state, v=v), jnp)
