"""The MJX engine: exact derivatives with respect to every unknown, and many simulations at once on a GPU.

Take derivatives in forward mode (`jax.jacfwd`, `jax.jvp`): reverse mode fails or is wrong through contact.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from det2stoc_bayes.engines.base import Counter, EffectRows, Request, Start, Trajectory
from det2stoc_bayes.engines.mjx_simulation import NEEDED_NONZERO, Simulation
from det2stoc_bayes.engines.mjx_step import in_fields
from det2stoc_bayes.engines.mjx_support import check_supported
from det2stoc_bayes.mismatch.effects.base import PlacedEffect

if TYPE_CHECKING:
    from det2stoc_bayes.problem import Problem

MAX_CHUNK = {"cpu": 256}
MAX_CHUNK_ACCELERATOR = 4096
FARTHEST = 8.0  # sds of a prior within which an effect's memory of commands is provided for
Predict = Callable[..., Float[Array, "segments samples columns"]]


class Mjx:
    """Simulation in MJX, in double precision. Forces that depend on the state are held over a timestep."""

    name = "mjx"

    def __init__(self, model: mujoco.MjModel):
        jax.config.update("jax_enable_x64", True)
        check_supported(model)
        self._model = model
        self._compiled: dict[Any, tuple[Simulation, Any]] = {}
        self.counter = Counter()

    def rollout(self, request: Request) -> Float[np.ndarray, "sims samples columns"]:
        """Predicted values at the sample times; NaN where a simulation diverged."""
        return self.trajectory(request).columns

    def trajectory(self, request: Request) -> Trajectory:
        """Predicted values and states; simulations with the same effects share a compiled program."""
        sizes = (len(request.segments.columns), self._model.nq, self._model.nv, self._model.na)
        out = [np.empty((len(request.which), request.segments.time.shape[1], size)) for size in sizes]
        for rows, effects, parameters in _groups(request.effects, len(request.which)):
            fields = {name: np.asarray(values)[rows] for name, values in request.fields.items()}
            for whole, part in zip(out, self._run(request, rows, fields, effects, parameters), strict=True):
                whole[rows] = part
        columns = out[0]
        columns[~np.isfinite(columns).all((1, 2)) | (np.abs(columns).max((1, 2)) > 1e9)] = np.nan
        return Trajectory(*out)

    def simulation(
        self,
        columns: Sequence[str],
        effects: Sequence[PlacedEffect],
        fields: Mapping[str, Float[np.ndarray, "sims ..."]],
        timestep: float | None = None,
        integrator: str | None = None,
    ) -> tuple[Simulation, Callable]:
        """The program for this structure, and its vectorized compiled form; kept for the next time.

        `fields` are examples of the values to come: which ones are not 0 decides what the program contains.
        """
        nonzero = _nonzero(self._model, fields, effects)
        key = (tuple(columns), tuple(effects), tuple(fields), timestep, integrator, nonzero)
        if key not in self._compiled:
            model = _with_options(self._model, timestep, integrator)
            one = Simulation(model, columns, effects, tuple(fields), nonzero)
            # Only the axes of start, times, commands, fields and parameters are simulations.
            many = jax.jit(_vmapped(one.trajectory), static_argnums=0)
            self._compiled[key] = one, many
        return self._compiled[key]

    def predict_fn(self, problem: "Problem", start: Start) -> Predict:
        """`predict(z, change=None)`: values of every segment for one vector of unknowns, from given starts.

        `change` (segments, 2 nv) moves the starts along tangent vectors (positions, velocities). Pure,
        jittable and differentiable in forward mode with respect to both.
        """
        return _Predict(self, problem, start)

    def _run(self, request: Request, rows: Int[np.ndarray, " n"], fields, effects, parameters) -> list[np.ndarray]:
        one, many = self.simulation(request.segments.columns, effects, fields, request.timestep, request.integrator)
        segments, which = request.segments, request.which[rows]
        before = _num_before(effects, parameters, one.dt)
        num_steps = int(segments.steps(one.dt)[request.which].max())
        used, inverse = np.unique(which, return_inverse=True)
        commands = segments.commands(used, one.dt, num_steps + 1, before)
        size = MAX_CHUNK.get(jax.default_backend(), MAX_CHUNK_ACCELERATOR)
        out = []
        for begin in range(0, len(rows), size):
            # Padded to a power of two, so that few sizes are compiled.
            length = min(size, len(rows) - begin)
            pick = np.minimum(np.arange(begin, begin + 2 ** int(np.ceil(np.log2(length)))), len(rows) - 1)
            start = request.start[rows[pick]]
            result = many(
                before,
                (start.qpos, start.qvel, start.act),
                segments.time[which[pick]],
                commands.map(lambda a, chosen=inverse[pick]: a[chosen]),
                {n: v[pick] for n, v in fields.items()},
                [{n: v[pick] for n, v in p.items()} for p in parameters],
            )
            out.append([np.asarray(a)[:length] for a in result])
            self.counter.simulations += length
            self.counter.steps += length * num_steps
        return [np.concatenate(parts) for parts in zip(*out, strict=True)]


class _Predict:
    """Predictions of a problem's segments from fixed starts."""

    def __init__(self, engine: Mjx, problem: "Problem", start: Start):
        self._problem, segments = problem, problem.segments
        names = [segments.recordings[r].name for r in segments.recording]
        examples = np.random.default_rng(0).standard_normal((3, problem.size))
        fields = [problem.simulator.fields(problem.psi_by_segment(z), names) for z in examples]
        merged = {name: np.concatenate([f[name] for f in fields]) for name in fields[0]}
        self._one, _ = engine.simulation(
            segments.columns, problem.effects, merged, problem.timestep, problem.integrator
        )
        self._fields = {name: jnp.asarray(value) for name, value in fields[0].items()}
        # Where a recording's known value stands, psi says nothing.
        self._open = {name: np.any([f[name] != fields[0][name] for f in fields], axis=0) for name in fields[0]}
        farthest = [problem.effect_values(np.full((1, problem.size), s)) for s in (-FARTHEST, FARTHEST)]
        self._before = max(_num_before(problem.effects, values, self._one.dt) for values in farthest)
        num_steps = int(segments.steps(self._one.dt).max())
        commands = segments.commands(np.arange(segments.count), self._one.dt, num_steps + 1, self._before)
        self._commands = commands.map(jnp.asarray)
        self._time = jnp.asarray(segments.time)
        self._start = tuple(jnp.asarray(a) for a in (start.qpos, start.qvel, start.act))
        self._model = problem.simulator.model

    def __call__(
        self, z: Float[Array, " size"], change: Float[Array, "segments states"] | None = None
    ) -> Float[Array, "segments samples columns"]:
        psi, parameters = self._problem.psi_by_segment(z, jnp), self._problem.effect_values(z, jnp)
        fields = dict(self._fields)
        for j, where in enumerate(self._problem.simulator.addresses):
            for place in where.places:
                at = (slice(None), *place)
                value = jnp.where(self._open[where.field][at], psi[:, j], fields[where.field][at])
                fields[where.field] = fields[where.field].at[at].set(value)
        start = self._start if change is None else jax.vmap(self._moved)(self._start, change)
        run = jax.vmap(lambda s, t, u, f: self._one(s, t, u, f, parameters, self._before))
        return run(start, self._time, self._commands, fields)

    def _moved(self, start, change):
        qpos, qvel, act = start
        nv, model = self._model.nv, self._model
        moved = qpos
        for j in range(model.njnt):
            kind, q, v = int(model.jnt_type[j]), int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            if kind != mujoco.mjtJoint.mjJNT_BALL:
                straight = 3 if kind == mujoco.mjtJoint.mjJNT_FREE else 1
                moved = moved.at[q : q + straight].add(change[v : v + straight])
            if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
                q, v = (q + 3, v + 3) if kind == mujoco.mjtJoint.mjJNT_FREE else (q, v)
                moved = moved.at[q : q + 4].set(_rotated(qpos[q : q + 4], change[v : v + 3]))
        return moved, qvel + change[nv:], act


def _rotated(quaternion: Float[Array, "4"], turn: Float[Array, "3"]) -> Float[Array, "4"]:
    angle = jnp.sqrt(turn @ turn + 1e-30)  # differentiable where nothing turns
    w, x = jnp.cos(angle / 2), turn * jnp.sin(angle / 2) / angle
    v, u = quaternion[1:], quaternion[0]
    return jnp.concatenate([(u * w - v @ x)[None], u * x + w * v + jnp.cross(v, x)])


def _groups(
    effects: Sequence[EffectRows], count: int
) -> Iterator[tuple[Int[np.ndarray, " n"], tuple[PlacedEffect, ...], list[dict[str, np.ndarray]]]]:
    """Rows on which the same effects act, those effects, and their parameters for each of the rows."""
    acting = np.zeros((len(effects), count), bool)
    for i, e in enumerate(effects):
        acting[i, e.rows] = True
    kinds, member = np.unique(acting, axis=1, return_inverse=True)
    for k in range(kinds.shape[1]):
        rows = np.flatnonzero(np.ravel(member) == k)
        chosen = [e for e, on in zip(effects, kinds[:, k], strict=True) if on]
        parameters = [
            {n: np.asarray(v, float)[rows - e.rows.indices(count)[0]] for n, v in e.parameters.items()} for e in chosen
        ]
        yield rows, tuple(e.placed for e in chosen), parameters


def _num_before(effects: Sequence[PlacedEffect], parameters: Sequence[Mapping[str, np.ndarray]], dt: float) -> int:
    """Steps before a start whose commands still matter."""
    return max(
        (
            int(np.ceil(e.effect.memory(p) / dt)) + 2
            for e, p in zip(effects, parameters, strict=True)
            if e.effect.uses("control")
        ),
        default=0,
    )


def _nonzero(model: mujoco.MjModel, fields, effects: Sequence[PlacedEffect]) -> frozenset[tuple[str, int]]:
    """Places where some simulation is not 0, in fields that MJX leaves out where the model is 0."""
    found: set[tuple[str, int]] = set()
    for name in NEEDED_NONZERO:
        base = _field(model, name)
        values = np.reshape(fields[name], (-1, base.size)) if name in fields else base.reshape(1, -1)
        found |= {(name, int(i)) for i in np.flatnonzero((values != 0).any(0))}
        for e in effects:
            if in_fields(e) and name in e.effect.changes:
                others = {n: _field(model, n)[None] for n in e.effect.changes if n != name}
                ones = {p.name: np.ones((1, p.size) if p.size > 1 else 1) for p in e.effect.parameters}
                after = e.effect.fields(ones, {name: base[None], **others}, e.element, np)[name]
                found |= {(name, int(i)) for i in np.flatnonzero(np.ravel(after) != np.ravel(base))}
            if name == "dof_frictionloss" and name in e.effect.writes:
                found.add((name, e.element.dof))
    return frozenset(found)


def _field(model: mujoco.MjModel, name: str) -> np.ndarray:
    return np.array(getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name), float)


def _with_options(model: mujoco.MjModel, timestep: float | None, integrator: str | None) -> mujoco.MjModel:
    model = copy.copy(model)
    if timestep is not None:
        model.opt.timestep = timestep
    if integrator is not None:
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    return model


def _vmapped(trajectory: Callable) -> Callable:
    """Over simulations: the axes of start, times, commands, fields and parameters, but not the static look-back."""

    def many(before, *arrays):
        return jax.vmap(lambda *one: trajectory(*one, before))(*arrays)

    return many
