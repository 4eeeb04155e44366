"""One simulation in MJX: a pure function of start, fields, effect parameters, commands and sample times."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float, Int

from det2stoc_bayes.engines.layout import LONGEST_BEND, column_address
from det2stoc_bayes.engines.mjx_constants import ancestor_matrix, derived_constants
from det2stoc_bayes.engines.mjx_model import COMPILED, braking, with_limits, with_tiny
from det2stoc_bayes.engines.mjx_step import Parameters, Stepper, field_of, in_fields, put_model
from det2stoc_bayes.engines.mjx_support import check_effect, check_fields, check_supported
from det2stoc_bayes.mismatch.effects.base import PlacedEffect
from det2stoc_bayes.segments import TIME_SLACK, Commands

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
_SERIES = ("qpos", "qvel", "act", "sensordata")


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
        self._model = put_model(model)
        changed = {*fields, *(f for e in effects if in_fields(e) for f in e.effect.changes)}
        self._ancestors = ancestor_matrix(model)
        self._rederive = bool(changed & _INERTIAL)
        self._sensors = any(a.source == "sensordata" for a in self.addresses)
        self._stepper = Stepper(model, self.effects, self._sensors)

    def __call__(self, *args: Any) -> Float[Array, "samples columns"]:
        """The columns of `trajectory`."""
        return self.trajectory(*args)[0]

    def trajectory(
        self,
        start: tuple[Float[Array, " nq"], Float[Array, " nv"], Float[Array, " na"]],
        stamps: Float[Array, " samples"],
        commands: Commands,
        fields: Mapping[str, Float[Array, "..."]],
        parameters: Sequence[Parameters],
        num_before: int = 0,
    ) -> tuple[Float[Array, "samples columns"], Float[Array, "samples nq"], Float[Array, "samples nv"], Array]:
        """Columns, qpos, qvel, act at the sample times.

        The first `num_before` commands precede the start; the last one is that of the step after the last.
        """
        model = self.model(fields, parameters)
        qvel = start[1]

        def advance(state, u):
            state, sensors = self._stepper.advance(model, parameters, state, u)
            return state, (*state[:3], state[6], sensors)

        ctrl = self._arriving(model, parameters, commands.each, stamps[0] - num_before * self.dt)
        anchors = self._stepper.first_anchors(start[0])
        first = (*start, jnp.zeros_like(qvel), stamps[0], qvel, anchors)
        _, (*states, sensors) = jax.lax.scan(advance, first, ctrl[num_before:])
        # Sensor values describe the state before the step; the last step is there for them alone.
        states = [jnp.concatenate([a[None], b[:-1]]) for a, b in zip((*start, anchors), states, strict=True)]
        series = dict(zip(_SERIES, (*states[:3], sensors), strict=True)) | {"anchors": states[3]}
        at = (stamps - stamps[0]) / self.dt
        bends = self._bends(model, parameters, series, stamps, commands, num_before)
        columns = self._read(series, bends, stamps, parameters)
        qpos, qvel, act = (_interpolate(series[name], at) + bends.get(name, 0.0) for name in _SERIES[:3])
        return columns, qpos, qvel, act

    def _arriving(self, model, parameters, ctrl, begin) -> Float[Array, "steps nu"]:
        """What arrives at the actuators, given commands from a time on."""
        time = begin + jnp.arange(len(ctrl)) * self.dt
        for placed, p in zip(self.effects, parameters, strict=True):
            if placed.effect.uses("control"):
                a = placed.element.ctrl
                ctrl = ctrl.at[:, a].set(placed.effect.control(p, ctrl[:, a], time, model.opt.timestep, jnp))
        return ctrl

    def _bends(self, model, parameters, series, stamps, commands, num_before) -> dict[str, Array]:
        """As in the C engine: how far samples between steps lie off the straight line between these."""
        if commands.around is None:
            return {}
        at = (stamps - stamps[0]) / self.dt
        low = _whole(at, len(commands.each) - num_before - 1)
        between = (at - low > 10 * TIME_SLACK) & (low + 1 - at > 10 * TIME_SLACK)
        share = jnp.where(between, at - low, 1.0)

        def one(k, s, until, after):
            past = jax.lax.dynamic_slice_in_dim(commands.each, k, num_before)
            begin = stamps[0] + (k - num_before) * self.dt
            u, v = (
                self._arriving(model, parameters, jnp.concatenate([past, c[None]]), begin)[-1] for c in (until, after)
            )
            shorter = model.tree_replace({"opt.timestep": model.opt.timestep * s})
            state = tuple(series[name][k] for name in _SERIES[:3])
            state = (*state, jnp.zeros_like(state[1]), stamps[0] + k * self.dt, series["qvel"][jnp.maximum(k - 1, 0)])
            state = (*state, series["anchors"][k])
            state, _ = self._stepper.advance(shorter, parameters, state, u, s)
            sensors = (
                self._stepper.advance(shorter, parameters, state, v)[1] if self._sensors else series["sensordata"][k]
            )
            return *state[:3], sensors

        reached = jax.vmap(one)(low, share, *commands.around)
        return {
            name: jnp.where(between[:, None], values - _interpolate(series[name], at), 0.0)
            for name, values in zip(_SERIES, reached, strict=True)
        }

    def model(self, fields: Mapping[str, Float[Array, "..."]], parameters: Sequence[Parameters]) -> Any:
        """The mjx.Model with varied fields, changed by effects, and the constants that follow from them."""
        changed = {name: jnp.asarray(value, float) for name, value in fields.items()}
        for placed, p in zip(self.effects, parameters, strict=True):
            if in_fields(placed):
                inside = {n: changed[n] if n in changed else field_of(self._model, n) for n in placed.effect.changes}
                changed |= placed.effect.fields(p, inside, placed.element, jnp)
        changed = {name: value for name, value in changed.items() if name not in COMPILED}
        for name, there in (
            ("dof_frictionloss", self._model._impl.dof_hasfrictionloss),
            ("tendon_frictionloss", self._model._impl.tendon_hasfrictionloss),
        ):
            if name in changed:  # a row that the program has brakes like a damper where its friction is 0
                changed[name] = braking(there, changed[name])
        model = self._model.tree_replace(changed)
        return derived_constants(model, self._stepper.data, self._ancestors) if self._rederive else model

    def _read(self, series, bends, stamps, parameters) -> Float[Array, "samples columns"]:
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
            if bends:
                value = value + bends[address.source][:, address.index]
            for effect, p in acting:
                value = effect.reading(p, stamps, value, jnp)
            out.append(value)
        return jnp.stack(out, -1)


def _whole(at: Float[Array, " samples"], num_steps: int) -> Int[Array, " samples"]:
    """The step in which each time lies."""
    return jnp.clip(jnp.floor(jax.lax.stop_gradient(at)).astype(int), 0, num_steps - 1)


def _interpolate(values: Float[Array, "steps *k"], at: Float[Array, " samples"]) -> Float[Array, "samples *k"]:
    """As in the C engine."""
    low = _whole(at, len(values) - 1)
    wide = tuple(range(1, values.ndim))
    share, before = jnp.expand_dims(at - low, wide), jnp.expand_dims(jnp.clip(at, -LONGEST_BEND, 0.0), wide)
    out = (1 - share) * values[low] + share * values[low + 1]
    if len(values) < 3:
        return out
    return out + 0.5 * before * (before - 1) * (values[2] - 2 * values[1] + values[0])
