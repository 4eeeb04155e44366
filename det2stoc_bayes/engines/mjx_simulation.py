"""One simulation in MJX: a pure function of start, fields, effect parameters, commands and sample times."""

import contextlib
import io
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from det2stoc_bayes.engines import drive
from det2stoc_bayes.engines.layout import LONGEST_BEND, column_address
from det2stoc_bayes.engines.mjx_constants import ancestor_matrix, derived_constants
from det2stoc_bayes.engines.mjx_model import braking, with_limits, with_tiny
from det2stoc_bayes.engines.mjx_support import check_effect, check_fields, check_supported
from det2stoc_bayes.mismatch.effects.base import BodyState, JointState, PlacedEffect

with contextlib.redirect_stdout(io.StringIO()):  # it prints that warp is missing, which nothing here uses
    from mujoco import mjx
    from mujoco.mjx._src.forward import _integrate_pos  # it has no public name

SLOW_SPIN = 3e-8  # rad/s; MJX takes less than 1e-8 for no rotation at all, with no derivatives either
NEEDED_NONZERO = (
    "dof_frictionloss",
    "tendon_frictionloss",
    "body_gravcomp",
    "opt.density",
    "opt.viscosity",
    "opt.wind",
)
_INERTIAL = {
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_pos",
    "body_quat",
    "jnt_pos",
    "jnt_axis",
    "dof_armature",
    "tendon_armature",
    "actuator_gear",
}
Parameters = Mapping[str, Any]


class Simulation:
    """What is fixed when a simulation is compiled: model, columns, effects and which model fields vary."""

    def __init__(
        self,
        model: mujoco.MjModel,
        columns: Sequence[str],
        effects: Sequence[PlacedEffect],
        fields: Sequence[str],
        nonzero: frozenset[tuple[str, int]] = frozenset(),
    ):
        check_fields(model, fields)
        for placed in effects:
            check_effect(model, placed)
        model = with_limits(with_tiny(model, nonzero), effects)
        check_supported(model)
        self.dt, self.columns, self.effects = float(model.opt.timestep), tuple(columns), tuple(effects)
        self.addresses = [column_address(model, c) for c in columns]
        self._model, self._data, self._kinds = mjx.put_model(model), mjx.make_data(model), model
        changed = {*fields, *(f for e in effects if in_fields(e) for f in e.effect.changes)}
        self._ancestors = ancestor_matrix(model)
        # As in the C engine: a force held over a step of RK4 is that of the middle of the step.
        self._lead = 0.5 * self.dt if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.0
        self._rederive = bool(changed & _INERTIAL)
        self._spins = [
            int(v) + {0: 3, 1: 0}[int(k)] for k, v in zip(model.jnt_type, model.jnt_dofadr, strict=True) if k < 2
        ]
        self._sensors = any(a.source == "sensordata" for a in self.addresses)
        self._forced = [i for i, e in enumerate(effects) if not in_fields(e) and e.effect.uses("joint_force")]
        self._momentary = [i for i, e in enumerate(effects) if e.effect.writes]
        self._pushed = [i for i, e in enumerate(effects) if e.effect.uses("body_force")]

    def __call__(self, *args: Any) -> Float[Array, "samples columns"]:
        """The columns of `trajectory`."""
        return self.trajectory(*args)[0]

    def trajectory(
        self,
        start: tuple[Float[Array, " nq"], Float[Array, " nv"], Float[Array, " na"]],
        stamps: Float[Array, " samples"],
        ctrl: Float[Array, "steps nu"],
        fields: Mapping[str, Float[Array, "..."]],
        parameters: Sequence[Parameters],
        num_before: int = 0,
    ) -> tuple[Float[Array, "samples columns"], Float[Array, "samples nq"], Float[Array, "samples nv"], Array]:
        """Columns, qpos, qvel, act at the sample times.

        The first `num_before` commands precede the start; the last one is that of the step after the last.
        """
        model = self.model(fields, parameters)
        time = stamps[0] + (jnp.arange(len(ctrl)) - num_before) * self.dt
        for placed, p in zip(self.effects, parameters, strict=True):
            if placed.effect.uses("control"):
                a = placed.element.ctrl
                ctrl = ctrl.at[:, a].set(placed.effect.control(p, ctrl[:, a], time, model.opt.timestep, jnp))
        qpos, qvel, act = start

        def advance(state, u):
            data = self._data.replace(
                qpos=state[0],
                qvel=self._turning(state[1]),
                act=state[2],
                qacc_warmstart=state[3],
                time=state[4],
                ctrl=u,
            )
            middle = data.qvel + 0.5 * (state[1] - state[5]) if self._lead else data.qvel
            after, sensors = self._step(model, data, parameters, middle)
            # Time is the recorded clock's, whatever a step of it lasts.
            state = (after.qpos, after.qvel, after.act, after.qacc_warmstart, state[4] + self.dt, state[1])
            return state, (after.qpos, after.qvel, after.act, sensors)

        first = (qpos, qvel, act, jnp.zeros_like(qvel), stamps[0], qvel)
        _, (*states, sensors) = jax.lax.scan(advance, first, ctrl[num_before:])
        # Sensor values describe the state before the step; the last step is there for them alone.
        states = [jnp.concatenate([a[None], b[:-1]]) for a, b in zip(start, states, strict=True)]
        series = {"qpos": states[0], "qvel": states[1], "sensordata": sensors}
        at = (stamps - stamps[0]) / self.dt
        qpos, qvel, act = (_interpolate(s, at) for s in states)
        return self._read(series, stamps, parameters), qpos, qvel, act

    def model(self, fields: Mapping[str, Float[Array, "..."]], parameters: Sequence[Parameters]) -> Any:
        """The mjx.Model with varied fields, changed by effects, and the constants that follow from them."""
        changed = {name: jnp.asarray(value, float) for name, value in fields.items()}
        for placed, p in zip(self.effects, parameters, strict=True):
            if in_fields(placed):
                inside = {n: changed[n] if n in changed else _get(self._model, n) for n in placed.effect.changes}
                changed |= placed.effect.fields(p, inside, placed.element, jnp)
        for name, there in (
            ("dof_frictionloss", self._model._impl.dof_hasfrictionloss),
            ("tendon_frictionloss", self._model._impl.tendon_hasfrictionloss),
        ):
            if name in changed:  # a row that the program has brakes like a damper where its friction is 0
                changed[name] = braking(there, changed[name])
        model = self._model.tree_replace(changed)
        return derived_constants(model, self._data, self._ancestors) if self._rederive else model

    def _turning(self, qvel: Float[Array, " nv"]) -> Float[Array, " nv"]:
        for v in self._spins:
            spin = qvel[v : v + 3]
            qvel = qvel.at[v : v + 3].add(jnp.where(jnp.all(jnp.abs(spin) < SLOW_SPIN), SLOW_SPIN, 0.0))
        return qvel

    def _step(self, m, d, parameters, middle):
        """As mj_step; effects' forces are held over the step, those that are damping in MuJoCo linearized.

        `middle`: speeds where the forces are taken, as the last step's change foretells them.
        """
        m = self._now(m, d, parameters, middle)
        d = mjx.fwd_position(m, d)
        d = mjx.sensor_pos(m, d) if self._sensors else d
        m, d = self._joint_forces(m, d, parameters, middle)
        d = mjx.fwd_velocity(m, d)
        d = mjx.sensor_vel(m, d) if self._sensors else d
        d = self._body_forces(m, d, parameters, middle)
        d = mjx.fwd_acceleration(m, mjx.fwd_actuation(m, d))
        d = mjx.solve(m, d) if d._impl.efc_J.size else d.replace(qacc=d.qacc_smooth)
        d = mjx.sensor_acc(m, d) if self._sensors else d
        return _integrate(m, d), d.sensordata

    def _now(self, m, d, parameters, middle):
        """The model with the fields that effects rewrite at every step."""
        for i in self._momentary:
            effect, at = self.effects[i].effect, self.effects[i].element
            inside = {name: _get(m, name) for name in (*effect.writes, *effect.reads)}
            changed = effect.momentary(parameters[i], inside, self._joint_state(m, d, at, middle), at, jnp)
            changed.pop("actuator_forcelimited", None)  # compiled in
            if "dof_frictionloss" in changed:
                there = m._impl.dof_hasfrictionloss
                changed["dof_frictionloss"] = braking(there, changed["dof_frictionloss"])
            m = m.tree_replace(changed)
        return m

    def _joint_state(self, m, d, at, middle):
        time = d.time + self._lead
        if at.dof < 0:
            return JointState(0.0 * time, 0.0 * time, time)
        given = None
        if at.actuators:
            given = drive.drive_of(self._kinds, at, lambda name: _get(m, name), d.ctrl, d.act, jnp)
        way = self._lead * 0.5 * (d.qvel + middle)[at.dof]
        return JointState(d.qpos[at.qpos] + way, middle[at.dof], time, given)

    def _joint_forces(self, m, d, parameters, middle):
        force, damping = d.qfrc_applied, m.dof_damping
        for i in self._forced:
            effect, at = self.effects[i].effect, self.effects[i].element
            # Where MuJoCo has it as damping, it follows the speed within a step by itself.
            v = d.qvel[at.dof] if effect.changes else middle[at.dof]
            q = d.qpos[at.qpos] + self._lead * 0.5 * (d.qvel + middle)[at.dof]

            def law(v, effect=effect, p=parameters[i], q=q):
                return effect.joint_force(p, JointState(q, v, d.time + self._lead), jnp)

            value = law(v)
            if effect.changes:  # MuJoCo treats it as damping, implicitly: its slope joins the damping
                slope = jax.jvp(law, (v,), (jnp.ones_like(v),))[1]
                damping, value = damping.at[at.dof].add(-slope), value - slope * v
            force = force.at[at.dof].add(value)
        return m.replace(dof_damping=damping), d.replace(qfrc_applied=force)

    def _body_forces(self, m, d, parameters, middle):
        wrench, now = d.xfrc_applied, d
        if self._pushed and self._lead:
            way = 0.5 * (d.qvel + middle)
            now = d.replace(qpos=_integrate_pos(self._kinds.jnt_type, d.qpos, way, self._lead), qvel=middle)
            now = mjx.com_vel(m, mjx.com_pos(m, mjx.kinematics(m, now)))
        for i in self._pushed:
            body = self.effects[i].element.body
            spin, lever = now.cvel[body, :3], now.xipos[body] - now.subtree_com[m.body_rootid[body]]
            geoms = np.flatnonzero(self._kinds.geom_bodyid == body)
            shapes = tuple(int(t) for t in self._kinds.geom_type[geoms])
            velocity, time = now.cvel[body, 3:] + jnp.cross(spin, lever), d.time + self._lead
            state = BodyState(velocity, time, spin, shapes, m.geom_size[geoms])
            wrench = wrench.at[body, :3].add(self.effects[i].effect.body_force(parameters[i], state, jnp))
        return d.replace(xfrc_applied=wrench)

    def _read(self, series, stamps, parameters) -> Float[Array, "samples columns"]:
        out = []
        for column, address in zip(self.columns, self.addresses, strict=True):
            acting = [
                (e.effect, p)
                for e, p in zip(self.effects, parameters, strict=True)
                if e.element.kind == "sensor" and e.element.column in (column, "time")
            ]
            times = stamps
            for effect, p in acting:
                times = effect.sample_time(p, times, jnp)
            value = _interpolate(series[address.source][:, address.index], (times - stamps[0]) / self.dt)
            for effect, p in acting:
                value = effect.reading(p, stamps, value, jnp)
            out.append(value)
        return jnp.stack(out, -1)


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


def _get(model, name: str):
    holder, _, leaf = name.rpartition(".")
    return getattr(model.opt if holder == "opt" else model, leaf)


def _interpolate(values: Float[Array, "steps *k"], at: Float[Array, " samples"]) -> Float[Array, "samples *k"]:
    """As in the C engine."""
    low = jnp.clip(jnp.floor(jax.lax.stop_gradient(at)).astype(int), 0, len(values) - 2)
    wide = tuple(range(1, values.ndim))
    share, before = jnp.expand_dims(at - low, wide), jnp.expand_dims(jnp.clip(at, -LONGEST_BEND, 0.0), wide)
    out = (1 - share) * values[low] + share * values[low + 1]
    if len(values) < 3:
        return out
    return out + 0.5 * before * (before - 1) * (values[2] - 2 * values[1] + values[0])
