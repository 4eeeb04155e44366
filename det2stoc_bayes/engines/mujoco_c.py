"""The C engine: many simulations at once on all cores through `mujoco.batch`."""

import copy
import threading
from collections.abc import Mapping
from dataclasses import astuple

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.engines.base import Counter, EffectRows, Request, Trajectory
from det2stoc_bayes.engines.layout import column_address
from det2stoc_bayes.mismatch.effects.base import BodyState, JointState
from det2stoc_bayes.segments import TIME_SLACK

MAX_SIMULATIONS = 4096
MAX_PERSISTENT = 512  # simulations that keep an MjData each (some 100 KB and more)
MAX_RECORDED = 24_000_000  # numbers held at once: about 200 MB
_BAD_STATE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BADQ{x}")) for x in ("POS", "VEL", "ACC")]
_STATE = mujoco.mjtState
_SET_CONST_INPUTS = frozenset(mujoco.MjModel._setconst_inputs)


class MujocoC:
    """Batched simulation in C. Forces that depend on the state are held over a timestep."""

    name = "c"

    def __init__(self, model: mujoco.MjModel, num_threads: int = 0):
        self._models: dict[tuple[float | None, str | None], mujoco.MjModel] = {(None, None): _without_autoreset(model)}
        self._threads = num_threads
        self.counter = Counter()

    def rollout(self, request: Request) -> Float[np.ndarray, "sims samples columns"]:
        """Predicted values at the sample times; NaN where a simulation diverged."""
        return self.trajectory(request, states=False).columns

    def trajectory(self, request: Request, *, states: bool = True) -> Trajectory:
        """Predicted values and states at the sample times, in chunks that fit in memory."""
        model = self._model(request.timestep, request.integrator)
        steps = request.segments.steps(model.opt.timestep)[request.which]
        width = model.nq + model.nv + model.nu + model.nsensordata
        keeping = any(e.placed.effect.uses("body_force") for e in request.effects)
        most = MAX_PERSISTENT if keeping else MAX_SIMULATIONS
        size = int(np.clip(MAX_RECORDED // (width * steps.max(initial=1)), 1, most))
        parts = []
        for begin in range(0, len(steps), size):
            rows = slice(begin, min(begin + size, len(steps)))
            with _QUIET:
                parts.append(_Chunk(model, request, rows, int(steps[rows].max()), self._threads).run(states))
            self.counter.simulations += rows.stop - rows.start
            self.counter.steps += (rows.stop - rows.start) * int(steps[rows].max())
        return (
            parts[0]
            if len(parts) == 1
            else Trajectory(*(np.concatenate(x) for x in zip(*map(astuple, parts), strict=True)))
        )

    def _model(self, timestep: float | None, integrator: str | None) -> mujoco.MjModel:
        key = (timestep, integrator)
        if key not in self._models:
            model = copy.copy(self._models[None, None])
            if timestep is not None:
                model.opt.timestep = timestep
            if integrator is not None:
                model.opt.integrator = mujoco.mjtIntegrator.__members__[f"mjINT_{integrator.upper()}"]
            self._models[key] = model
        return self._models[key]


def _without_autoreset(model: mujoco.MjModel) -> mujoco.MjModel:
    # A simulation that diverges must stay diverged, not start again from qpos0.
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


class _Quiet:
    """Keeps MuJoCo's warnings of simulations that diverge off the console and out of its log file."""

    def __init__(self):
        self._lock, self._depth, self._before = threading.Lock(), 0, (True, True)

    def __enter__(self):
        with self._lock:
            if self._depth == 0:
                config = mujoco.MjLogConfig.get()
                self._before = config.logto_console, config.logto_file
                _log_to(False, False)
            self._depth += 1

    def __exit__(self, *_):
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                _log_to(*self._before)


_QUIET = _Quiet()


def _log_to(console: bool, file: bool) -> None:
    config = mujoco.MjLogConfig.get()
    config.logto_console, config.logto_file = console, file
    config.set()


class _Chunk:
    """Simulations that are stepped together."""

    def __init__(self, model: mujoco.MjModel, request: Request, rows: slice, num_steps: int, threads: int):
        self.model, self.request, self.rows, self.num_steps = model, request, rows, num_steps
        self.count, self.dt = rows.stop - rows.start, model.opt.timestep
        self.which, self.segments = request.which[rows], request.segments
        self.effects = [e for e in (_restrict(e, rows) for e in request.effects) if e is not None]
        self.addresses = [column_address(model, c) for c in self.segments.columns]
        self.body_forces = any(e.placed.effect.uses("body_force") for e in self.effects)
        self.stepped = self.body_forces or any(_is_stepped(e) for e in self.effects)
        # A force is held over a step. RK4 weighs the whole step, so its position is taken at the middle; the Euler
        # integrators take every position force at the beginning.
        self.lead = 0.5 * self.dt if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.0
        self.batch = mujoco.batch.Batch(model, self.count, threads, persistent=self.body_forces)

    def run(self, states: bool) -> Trajectory:
        """Simulate and read off."""
        self._set_fields()
        start = self.request.start[self.rows]
        batch = self.batch
        batch.bind("time")[:] = self.segments.time[self.which, 0][:, None].reshape(batch.bind("time").shape)
        batch.bind("qpos")[:], batch.bind("qvel")[:] = start.qpos, start.qvel
        if self.model.na:
            batch.bind("act")[:] = start.act
        ctrl = self._commands()
        sources = {a.source for a in self.addresses}
        items = {"qpos", "qvel"} | sources | ({"act"} if states and self.model.na else set())
        record = self._step(ctrl, items) if self.stepped else self._roll(ctrl, items)
        series = {
            "qpos": np.concatenate([start.qpos[:, None], record["qpos"]], 1),
            "qvel": np.concatenate([start.qvel[:, None], record["qvel"]], 1),
        }
        if "sensordata" in sources:
            # Sensor values describe the state before the step; the last one is held.
            series["sensordata"] = np.concatenate([record["sensordata"], record["sensordata"][:, -1:]], 1)
        columns = self._read(series)
        if not states:
            empty = np.empty((*columns.shape[:2], 0))
            return Trajectory(columns, empty, empty, empty)
        if self.model.na:
            series["act"] = np.concatenate([start.act[:, None], record["act"]], 1)
        else:
            series["act"] = np.empty((*series["qpos"].shape[:2], 0))
        stamps = self.segments.time[self.which]
        at = (stamps - stamps[:, :1]) / self.dt
        return Trajectory(columns, *(_interpolate(series[name], at) for name in ("qpos", "qvel", "act")))

    def _set_fields(self) -> None:
        fields = {}
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
            self.batch.set_const()

    def _commands(self) -> Float[np.ndarray, "sims steps ctrl"]:
        acting = [e for e in self.effects if e.placed.effect.uses("control")]
        before = max((int(np.ceil(e.placed.effect.memory(e.parameters) / self.dt)) + 2 for e in acting), default=0)
        used, inverse = np.unique(self.which, return_inverse=True)
        ctrl = self.segments.commands(used, self.dt, self.num_steps, before)[inverse]
        for e in acting:
            a = e.placed.element.ctrl
            ctrl[e.rows, :, a] = e.placed.effect.control(e.parameters, ctrl[e.rows, :, a], self.dt, np)
        return ctrl[:, before:]

    def _roll(self, ctrl, items) -> Mapping:
        return self.batch.rollout(
            self.num_steps, ctrl if self.model.nu else None, int(_STATE.mjSTATE_CTRL), tuple(items)
        )

    def _step(self, ctrl, items) -> dict[str, np.ndarray]:
        batch, model = self.batch, self.model
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        force, wrench = batch.bind("qfrc_applied"), batch.bind("xfrc_applied")
        command = batch.bind("ctrl") if model.nu else None
        derived = {n: batch.bind(n) for n in ("cvel", "xipos", "subtree_com")} if self.body_forces else {}
        live = {name: batch.bind(name) for name in items}
        out = {name: np.empty((self.count, self.num_steps, array.shape[1])) for name, array in live.items()}
        stage = mujoco.mjtStage.mjSTAGE_VEL if self.body_forces else mujoco.mjtStage.mjSTAGE_NONE
        apart = self.body_forces and "sensordata" in live  # the stages of the new state would overwrite its sensors
        time = np.array(self.segments.time[self.which, 0])
        stepped = [e for e in self.effects if _is_stepped(e)]
        if self.body_forces:
            batch.forward(stage=stage)
        for k in range(self.num_steps):
            force[:], wrench[:] = 0.0, 0.0
            for e in stepped:
                self._apply(e, qpos, qvel, time, force, wrench, derived)
            if command is not None:
                command[:] = ctrl[:, k]
            batch.step(stage=mujoco.mjtStage.mjSTAGE_NONE if apart else stage)
            time += self.dt
            for name, array in live.items():
                out[name][:, k] = array
            if apart:
                batch.forward(stage=stage)
        return out

    def _apply(self, e: EffectRows, qpos, qvel, time, force, wrench, derived) -> None:
        at, rows = e.placed.element, e.rows
        if e.placed.effect.uses("body_force"):
            cvel, root = derived["cvel"][rows, at.body], self.model.body_rootid[at.body]
            lever = derived["xipos"][rows, at.body] - derived["subtree_com"][rows, root]
            state = BodyState(cvel[:, 3:] + np.cross(cvel[:, :3], lever), time[rows])
            wrench[rows, at.body, :3] += e.placed.effect.body_force(e.parameters, state, np)
        else:
            speed = qvel[rows, at.dof]
            state = JointState(qpos[rows, at.qpos] + self.lead * speed, speed, time[rows] + self.lead)
            force[rows, at.dof] += e.placed.effect.joint_force(e.parameters, state, np)

    def _frozen(self, speeds: Float[np.ndarray, "sims steps nv"]) -> Bool[np.ndarray, " sims"]:
        """Simulations that diverged before their own last sample (a shorter one may diverge after it unharmed)."""
        failed = (self.batch.warning[:, _BAD_STATE, 1] > 0).any(1)
        last = self.segments.steps(self.dt)[self.which]
        return failed & (speeds[np.arange(self.count), last] == speeds[:, -1]).all(1)

    def _read(self, series: dict[str, np.ndarray]) -> Float[np.ndarray, "sims samples columns"]:
        stamps = self.segments.time[self.which]
        out = np.empty((*stamps.shape, len(self.addresses)))
        for j, (column, address) in enumerate(zip(self.segments.columns, self.addresses, strict=True)):
            effects = [
                e
                for e in self.effects
                if e.placed.element.kind == "sensor" and e.placed.element.column in (column, "time")
            ]
            times = np.array(stamps)
            for e in effects:
                if e.placed.effect.uses("sample_time"):
                    times[e.rows] = e.placed.effect.sample_time(e.parameters, times[e.rows], np)
            values = series[address.source][:, :, address.index]
            out[:, :, j] = _interpolate(values[..., None], (times - stamps[:, :1]) / self.dt)[..., 0]
            for e in effects:
                if e.placed.effect.uses("reading"):
                    out[e.rows, :, j] = e.placed.effect.reading(e.parameters, stamps[e.rows], out[e.rows, :, j], np)
        # A diverged state is no prediction; the batch freezes such a simulation at its last one.
        out[self._frozen(series["qvel"])] = np.nan
        out[~np.isfinite(out).all((1, 2)) | (np.abs(out).max((1, 2)) > 1e9)] = np.nan
        return out


def _is_stepped(e: EffectRows) -> bool:
    effect = e.placed.effect
    return effect.uses("body_force") or (effect.uses("joint_force") and not effect.changes)


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
    """Linear between steps; a little before the first step along the first step's slope."""
    nearest = np.rint(at)
    at = np.where(np.abs(at - nearest) < TIME_SLACK * 10, nearest, at)
    low = np.clip(np.floor(at).astype(int), 0, values.shape[1] - 2)
    share = (at - low)[..., None]
    rows = np.arange(len(values))[:, None]
    return (1 - share) * values[rows, low] + share * values[rows, low + 1]
