"""Simulations in C that are stepped together."""

import copy
from collections.abc import Mapping, Sequence

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.engines.base import EffectRows, Request, Trajectory
from det2stoc_bayes.engines.layout import LONGEST_BEND, column_address
from det2stoc_bayes.engines.mujoco_following import Follower
from det2stoc_bayes.engines.mujoco_readings import Readings
from det2stoc_bayes.engines.mujoco_steps import Stepper, is_stepped
from det2stoc_bayes.segments import Commands, snapped

_BAD_STATE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BADQ{x}")) for x in ("POS", "VEL", "ACC")]
_STATE = mujoco.mjtState
_SET_CONST_INPUTS = frozenset(mujoco.MjModel._setconst_inputs)
# Inputs of mj_setConst from which only the fields below follow, and no counter of the model (as from gravcomp).
_PLAIN_INPUTS = frozenset({"body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature", "actuator_gear"})
_SET_CONST_OUTPUTS = (
    "actuator_acc0", "actuator_length0", "body_invweight0", "body_subtreemass", "dof_M0", "dof_invweight0",
    "dof_length", "eq_data", "tendon_invweight0", "tendon_length0",
)  # fmt: skip
ADHESION = frozenset({"geom_adhesion", "pair_adhesion"})
LIGHT = 24  # degrees of freedom in all, for which threads would wait for each other at every step longer than it takes
FEWER = 4  # times fewer different values than simulations: then each is derived once


class Chunk:
    """Simulations that are stepped together."""

    def __init__(self, model: mujoco.MjModel, request: Request, rows: slice, num_steps: int, threads: int):
        self.model, self.request, self.rows, self.num_steps = model, request, rows, num_steps
        self.count, self.dt = rows.stop - rows.start, model.opt.timestep
        self.which, self.segments = request.which[rows], request.segments
        self.effects = [e for e in (_restrict(e, rows) for e in request.effects) if e is not None]
        self.addresses = [column_address(model, c) for c in self.segments.columns]
        self.readings = Readings(self.segments, self.which, self.addresses, self.effects, self.dt)
        self.fields: dict[str, np.ndarray] = {}  # that simulations have for themselves
        self.before = num_before(self.effects, self.dt)
        self.stepped = any(is_stepped(e) for e in self.effects)
        # Stages kept between steps spare the Euler integrators a second computation of places; RK4 starts anew anyway.
        pushed = any(e.placed.effect.uses("body_force") for e in self.effects)
        kept = pushed and model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
        by_steps = self.stepped or request.observer is not None
        threads = 1 if by_steps and self.count * model.nv < LIGHT else threads
        changed = {*request.fields, *(name for e in self.effects for name in e.placed.effect.changes)}
        if not changed.isdisjoint(ADHESION):  # which MuJoCo looks at where the compiled model has some
            model = copy.copy(model)
            model.flg_adhesion = True
        self.batch = mujoco.batch.Batch(model, self.count, threads, persistent=kept)

    def run(self, states: bool) -> Trajectory:
        """Simulate and read off."""
        self._set_fields()
        start = self.request.start[self.rows]
        batch = self.batch
        batch.bind("time")[:] = self.segments.time[self.which, 0][:, None].reshape(batch.bind("time").shape)
        batch.bind("qpos")[:], batch.bind("qvel")[:] = start.qpos, start.qvel
        if self.model.na:
            batch.bind("act")[:] = start.act
        commands = self._commands()
        ctrl = self._arriving(commands.each)[:, self.before :]
        sources = {a.source for a in self.addresses}
        activated = bool(self.model.na) and (states or commands.around is not None)
        items = {"qpos", "qvel"} | sources | ({"act"} if activated else set())
        time = self.segments.time[self.which, 0]
        stepper = Stepper(self.model, batch, self.effects, time) if self.stepped else None
        if self.request.observer is not None:
            return Follower(self, ctrl, stepper).run()
        record = self.roll(ctrl, items) if stepper is None else stepper.run(ctrl, sorted(items))
        series = {
            "qpos": np.concatenate([start.qpos[:, None], record["qpos"]], 1),
            "qvel": np.concatenate([start.qvel[:, None], record["qvel"]], 1),
        }
        if "sensordata" in sources:
            # A step's sensors describe the state before it; those of the last state are computed apart.
            last = batch.bind("sensordata")
            batch.forward()
            series["sensordata"] = np.concatenate([record["sensordata"], last[:, None]], 1)
        if activated:
            series["act"] = np.concatenate([start.act[:, None], record["act"]], 1)
        frozen = self._frozen(series["qvel"])
        bends = self._bends(series, commands, stepper)

        def between(source, indices, _, at):  # of all simulations, as is asked below
            straight = _interpolate(series[source][:, :, indices], at)
            return straight + bends[source][:, :, indices] if bends else straight

        columns = self.readings.of(between, np.arange(self.count), slice(None))
        # A diverged state is no prediction; the batch freezes such a simulation at its last one.
        columns[frozen] = np.nan
        columns[~np.isfinite(columns).all((1, 2)) | (np.abs(columns).max((1, 2)) > 1e9)] = np.nan
        empty = np.empty((*columns.shape[:2], 0))
        if not states:
            return Trajectory(columns, empty, empty, empty)
        at = self.segments.in_steps(self.dt)[self.which]
        names = [name for name in series if name != "sensordata"]
        out = {name: _interpolate(series[name], at) + bends.get(name, 0.0) for name in names}
        return Trajectory(columns, out["qpos"], out["qvel"], out.get("act", empty))

    def _set_fields(self) -> None:
        fields = self.fields
        for name, values in self.request.fields.items():
            fields[name] = self.batch.expand(name)
            fields[name][:] = values[self.rows].reshape(fields[name].shape)
        for effect in self.effects:
            for name in effect.placed.effect.changes:
                fields.setdefault(name, self.batch.expand(name))
            inside = {name: fields[name][effect.rows] for name in effect.placed.effect.changes}
            for name, value in effect.placed.effect.fields(
                effect.parameters, inside, effect.placed.element, np
            ).items():
                fields[name][effect.rows] = value
        if any(name in _SET_CONST_INPUTS for name in fields):
            self._set_const()

    def _set_const(self) -> None:
        """What MuJoCo derives from the fields, once for each of their different values."""
        inputs = [name for name in self.fields if name in _SET_CONST_INPUTS]
        rows = np.concatenate([self.fields[name].reshape(self.count, -1) for name in inputs], 1)
        _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        if len(first) > self.count // FEWER or not _PLAIN_INPUTS.issuperset(inputs):
            self.batch.set_const()
            return
        few = mujoco.batch.Batch(self.model, len(first), 1)
        for name in inputs:
            few.expand(name)[:] = self.fields[name][first]
        few.set_const()
        derived: dict[str, list[np.ndarray]] = {name: [] for name in _SET_CONST_OUTPUTS}
        for i in range(len(first)):
            one = few.get_model(i)
            for name, values in derived.items():
                values.append(np.array(getattr(one, name)))
        for name, values in derived.items():
            if any((value != np.array(getattr(self.model, name))).any() for value in values):
                out = self.batch.expand(name)
                out[:] = np.stack(values).reshape(len(first), *out.shape[1:])[np.ravel(inverse)]

    def _commands(self) -> Commands:
        """Commands at every step, those before the start that still matter and the step after the last among them."""
        used, inverse = np.unique(self.which, return_inverse=True)
        commands = self.segments.commands(used, self.dt, self.num_steps + 1, self.before)
        return commands.map(lambda a: a[inverse])

    def _arriving(
        self, ctrl: Float[np.ndarray, "sims steps ctrl"], first: Int[np.ndarray, " sims"] | int = 0
    ) -> Float[np.ndarray, "sims steps ctrl"]:
        """What arrives at the actuators; commands are those from `before` steps before step `first` on."""
        acting = [e for e in self.effects if e.placed.effect.uses("control")]
        if not acting:
            return ctrl
        begin = self.segments.time[self.which, 0] + (np.asarray(first) - self.before) * self.dt
        time, out = begin[:, None] + np.arange(ctrl.shape[1]) * self.dt, np.array(ctrl)
        for e in acting:
            a = e.placed.element.ctrl
            step = self.fields["opt.timestep"][e.rows] if "opt.timestep" in self.fields else self.dt
            out[e.rows, :, a] = e.placed.effect.control(e.parameters, out[e.rows, :, a], time[e.rows], step, np)
        return out

    def _bends(
        self, series: Mapping[str, np.ndarray], commands: Commands, stepper: Stepper | None
    ) -> dict[str, Float[np.ndarray, "sims samples _"]]:
        """How far samples between steps lie off the straight line between these: each is reached by a shorter step.

        A command that comes within a step would else count too early: it acts on the step's end, not on the sample.
        """
        if commands.around is None:
            return {}
        at, rows = self.segments.in_steps(self.dt)[self.which], np.arange(self.count)
        low = np.clip(np.floor(at).astype(int), 0, self.num_steps - 1)
        share, between = at - low, (at > low) & (at < self.num_steps)
        out = {name: np.zeros((*at.shape, values.shape[-1])) for name, values in series.items()}
        step = self.batch.expand("opt.timestep")
        whole = np.array(step)
        live = {name: self.batch.bind(name) for name in series}
        states = [name for name in series if name != "sensordata"]
        for j in np.flatnonzero(between.any(0)):
            k = low[:, j]
            part = np.where(between[:, j], share[:, j], 1.0)
            for name in states:
                live[name][:] = series[name][rows, k]
            past = commands.each[rows[:, None], k[:, None] + np.arange(self.before)]
            until, after = (self._arriving(np.concatenate([past, u[:, j, None]], 1), k)[:, -1] for u in commands.around)
            step[:] = whole * part.reshape(-1, *(1,) * (step.ndim - 1))
            if stepper is not None:
                speeds = series["qvel"][rows, np.maximum(k - 1, 0)]
                stepper.part(until, speeds, k, part, after if "sensordata" in live else None)
            else:
                self._command(until)
                self.batch.step()
                self._command(after)
            if "sensordata" in live:
                self.batch.forward()
            step[:] = whole
            for name, values in live.items():
                a, b = series[name][rows, k], series[name][rows, k + 1]
                off = values - (a + part[:, None] * (b - a))
                out[name][:, j] = np.where(between[:, j, None], off, 0.0)
        return out

    def _command(self, ctrl: Float[np.ndarray, "sims ctrl"]) -> None:
        if self.model.nu:
            self.batch.bind("ctrl")[:] = ctrl

    def roll(self, ctrl, items) -> Mapping:
        """Arrays after every step that nothing but MuJoCo has a part in."""
        control = ctrl[:, :-1] if self.model.nu else None
        record = self.batch.rollout(ctrl.shape[1] - 1, control, int(_STATE.mjSTATE_CTRL), tuple(items))
        self._command(ctrl[:, -1])
        return record

    def failed(self) -> Bool[np.ndarray, " sims"]:
        """Simulations that diverged at any time."""
        return (self.batch.warning[:, _BAD_STATE, 1] > 0).any(1)

    def _frozen(self, speeds: Float[np.ndarray, "sims steps nv"]) -> Bool[np.ndarray, " sims"]:
        """Simulations that diverged before their own last sample (a shorter one may diverge after it unharmed)."""
        failed = (self.batch.warning[:, _BAD_STATE, 1] > 0).any(1)
        last = self.segments.steps(self.dt)[self.which]
        return failed & (speeds[np.arange(self.count), last] == speeds[:, -1]).all(1)


def num_before(effects: Sequence[EffectRows], dt: float) -> int:
    """Steps before a start whose commands still matter."""
    acting = [e for e in effects if e.placed.effect.uses("control")]
    return max((int(np.ceil(e.placed.effect.memory(e.parameters) / dt)) + 2 for e in acting), default=0)


def _restrict(e: EffectRows, rows: slice) -> EffectRows | None:
    begin, stop = max(e.rows.start, rows.start), min(e.rows.stop, rows.stop)
    if begin >= stop:
        return None
    inside = slice(begin - e.rows.start, stop - e.rows.start)
    return EffectRows(
        e.placed,
        slice(begin - rows.start, stop - rows.start),
        {name: values[inside] for name, values in e.parameters.items()},
    )


def _interpolate(
    values: Float[np.ndarray, "sims steps k"], at: Float[np.ndarray, "sims samples"]
) -> Float[np.ndarray, "sims samples k"]:
    """Linear between steps; before the first one, where a delayed sensor looks, along the first three's parabola.

    Farther back the parabola's bend stops: a start's transient would be blown up.
    """
    at = snapped(at)
    low = np.clip(np.floor(at).astype(int), 0, values.shape[1] - 2)
    share = (at - low)[..., None]
    rows = np.arange(len(values))[:, None]
    with np.errstate(invalid="ignore", over="ignore"):  # of what diverges
        out = (1 - share) * values[rows, low] + share * values[rows, low + 1]
        if values.shape[1] > 2 and (at < 0).any():
            before = np.clip(at, -LONGEST_BEND, 0.0)[..., None]
            bend = values[:, 2] - 2 * values[:, 1] + values[:, 0]
            out += 0.5 * before * (before - 1) * bend[:, None]
    return out
