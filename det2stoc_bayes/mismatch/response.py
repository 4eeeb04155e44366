"""What a small change anywhere along a trajectory does to the samples after it.

Along a fitted trajectory the simulation is a linear time-varying system: from sample to sample
    dx' = A dx + B f + d,    dy' = C dx + D f + e,
with f a generalized force held over the interval. A to D come from simulations one interval long, so that the
response to any history of forces, and to any other effect by its defects d and e, costs no long simulation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.engines.drive import drive_of
from det2stoc_bayes.engines.layout import integrate_positions, position_difference
from det2stoc_bayes.engines.places import Places, bodies_of, places
from det2stoc_bayes.linearization import START_STEP, Point
from det2stoc_bayes.mismatch.effects.base import Drive, Effect, Element, JointState, PlacedEffect, Typical
from det2stoc_bayes.mismatch.probes import Probe, of_command, of_gravity, of_joint, of_wind
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.problem import Problem, merge_requests
from det2stoc_bayes.segments import from_pieces

NUM_INSIDE = 8  # points of an interval at which a force is averaged
INSIDE = (np.arange(NUM_INSIDE) + 0.5) / NUM_INSIDE
COMMAND_STEP = 1e-3  # of a unit of the command: what follows is linear, or too stiff to see
FRICTION_STEP = 3e-3  # of the typical force: slips wherever the joint moves
GRAVITY_STEP = 1e-2  # m/s2
SWELL_STEP = 5e-3  # of the steady wind
FORCE_STEP = 1e-3  # of the force that would change the speed by its own spread in one interval


class Response:
    """The linear time-varying system along a fit's trajectory. Shapes: S segments, K intervals, m state, y columns."""

    def __init__(self, fit: Fit):
        self._set_out(fit.problem, fit.point, fit.problem.request(fit.point.z[None], fit.point.start))

    def _set_out(self, problem: Problem, point: Point, request: Request) -> None:
        """Linearizes the simulations that are requested, at the problem's point."""
        self.problem, self.point = problem, point
        segments, model = problem.segments, problem.simulator.model
        path = problem.simulator.engine.trajectory(request)
        self._fields = request.fields
        self.real = np.diff(segments.time, axis=1) > 0  # intervals that are not padding
        self.shape = self.real.shape
        self.pieces = [
            (int(segments.recording[s]), int(segments.first[s]) + k, int(segments.first[s]) + k + 2)
            for s, k in np.argwhere(self.real)
        ]
        self.intervals = from_pieces(segments.recordings, self.pieces, segments.columns)
        s, k = np.nonzero(self.real)
        self.begin = Start(path.qpos[s, k], path.qvel[s, k], path.act[s, k])
        self.path, self.state_size = path, 2 * model.nv + model.na
        self._inside: dict[tuple[int, int, tuple[int, ...]], JointState] = {}
        self._units: dict[tuple[str, int], tuple[np.ndarray, np.ndarray]] = {}
        self._linearize()

    def _request(self, start: Start, extra: Sequence[tuple[PlacedEffect, Mapping[str, Any]]] = ()) -> Request:
        problem = replace(self.problem, segments=self.intervals)
        request = problem.request(self.point.z[None], start)
        added = tuple(EffectRows.alike(p, len(self.pieces), values) for p, values in extra)
        return replace(request, effects=(*request.effects, *added))

    def _run(self, requests: Sequence[Request], origin=None):
        """End states in tangent coordinates about `origin` (its first request's if None) and end samples."""
        simulator = self.problem.simulator
        path = simulator.engine.trajectory(merge_requests(requests))
        count, model = len(self.pieces), simulator.model
        ends = [x[:, -1] for x in (path.qpos, path.qvel, path.act)]
        origin = [x[:count] for x in ends] if origin is None else origin
        tiled = [np.tile(x, (len(requests), 1)) for x in origin]
        state = np.concatenate(
            [position_difference(model, tiled[0], ends[0]), ends[1] - tiled[1], ends[2] - tiled[2]], 1
        )
        return (
            state.reshape(len(requests), count, -1),
            path.columns[:, -1].reshape(len(requests), count, -1),
            origin,
        )

    def _linearize(self) -> None:
        problem, model = self.problem, self.problem.simulator.model
        scale = np.concatenate([problem.guess.scale, np.ones(model.na)])
        steps = START_STEP * scale
        requests = [self._request(self.begin)]
        for i in range(self.state_size):
            change = np.zeros((len(self.pieces), self.state_size))
            change[:, i] = steps[i]
            requests.append(self._request(self._moved(change)))
        state, column, self._origin = self._run(requests)
        self._column = column[0]
        a = np.moveaxis(state[1:] - state[0], 0, -1) / steps
        c = np.moveaxis(column[1:] - column[0], 0, -1) / steps
        self.a, self.c = self._spread(np.nan_to_num(a)), self._spread(np.nan_to_num(c))

    def _moved(self, change: np.ndarray) -> Start:
        nv, model = self.problem.simulator.model.nv, self.problem.simulator.model
        return Start(
            integrate_positions(model, self.begin.qpos, change[:, :nv]),
            self.begin.qvel + change[:, nv : 2 * nv],
            self.begin.act + change[:, 2 * nv :],
        )

    def _spread(self, values: np.ndarray) -> np.ndarray:
        """Values of the real intervals laid out as (S, K, ...), zero in the padding."""
        out = np.zeros((*self.shape, *values.shape[1:]))
        out[self.real] = values
        return out

    def defects(self, trials: Sequence[tuple[PlacedEffect, Mapping[str, Any]]]) -> tuple[np.ndarray, np.ndarray]:
        """d (S, K, m, columns) and e (S, K, y, columns) of effects by simulating each interval with the effect on."""
        state, column, _ = self._run([self._request(self.begin, [t]) for t in trials], self._origin)
        return (
            self._spread(np.moveaxis(state, 0, -1)),
            self._spread(np.moveaxis(column - self._column, 0, -1)),
        )

    def commanded(
        self, at: Element, effect: Effect, trials: Sequence[Mapping[str, float]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """d and e of what an effect without memory makes of an actuator's commands: its mean over each interval."""
        segments, tried = self.problem.segments, [{n: np.array([v]) for n, v in t.items()} for t in trials]
        arriving, before = self._arriving
        u = arriving[..., at.ctrl]
        time = segments.time[:, :1] + (np.arange(u.shape[1]) - before) * self._dt
        change = np.stack([effect.control(p, u, time, self._dt, np) - u for p in tried], -1)[:, before:]
        total = np.concatenate([np.zeros_like(change[:, :1]), np.cumsum(change, 1)], 1)
        edges = np.rint((segments.time - segments.time[:, :1]) / self._dt).astype(int)
        whole = np.take_along_axis(total, edges[..., None], 1)
        mean = np.diff(whole, axis=1) / np.maximum(np.diff(edges, axis=1), 1)[..., None]
        b, d = self._unit(of_command(at), COMMAND_STEP)
        return b[..., None] * mean[:, :, None], d[..., None] * mean[:, :, None]

    @property
    def _dt(self) -> float:
        return self.problem.timestep or float(self.problem.simulator.model.opt.timestep)

    @cached_property
    def _arriving(self) -> tuple[Float[np.ndarray, "S steps nu"], int]:
        """What arrives at the actuators under the effects that are there, and how many steps come before the start."""
        problem, segments = self.problem, self.problem.segments
        values = problem.effect_values(self.point.z[None])
        there = [
            (p, {n: np.asarray(v) for n, v in given.items()})
            for p, given in zip(problem.effects, values, strict=True)
            if p.effect.uses("control")
        ]
        longest = max((p.effect.memory(v) for p, v in there), default=0.0)
        before, dt = int(np.ceil(longest / self._dt)) + 2, self._dt
        u = segments.commands(np.arange(segments.count), dt, int(segments.steps(dt).max()) + 1, before).each
        time = segments.time[:, :1] + (np.arange(u.shape[1]) - before) * dt
        for p, v in there:
            u[..., p.element.ctrl] = p.effect.control(v, u[..., p.element.ctrl], time, dt, np)
        return u, before

    def forced(self, dof: int, forces: Float[np.ndarray, "S K columns"]) -> tuple[np.ndarray, np.ndarray]:
        """d and e of generalized forces on one degree of freedom, held over each interval."""
        scale = float(self.problem.guess.scale[self.problem.simulator.model.nv + dof])
        b, d = self._unit(of_joint("dof", "constant_force", dof), FORCE_STEP * scale)
        return b[..., None] * forces[:, :, None], d[..., None] * forces[:, :, None]

    def rubbed(
        self, dof: int, sizes: Float[np.ndarray, "S K columns"], typical: Typical
    ) -> tuple[np.ndarray, np.ndarray]:
        """d and e of dry friction on one degree of freedom, of one size over each interval."""
        b, d = self._unit(of_joint("friction", "coulomb_friction", dof), FRICTION_STEP * typical.force)
        return b[..., None] * sizes[:, :, None], d[..., None] * sizes[:, :, None]

    def pulled(self, acceleration: Float[np.ndarray, "S K 3 columns"]) -> tuple[np.ndarray, np.ndarray]:
        """d and e of a change of gravity, held over each interval."""
        d, e = zip(*(self._unit(of_gravity(axis), GRAVITY_STEP) for axis in range(3)), strict=True)
        scaled = [
            sum(unit[..., None] * acceleration[:, :, axis, None] for axis, unit in enumerate(units)) for units in (d, e)
        ]
        return np.asarray(scaled[0]), np.asarray(scaled[1])

    def swelled(self, placed: PlacedEffect, parts: Float[np.ndarray, "S K columns"]) -> tuple[np.ndarray, np.ndarray]:
        """d and e of a wind that grows by so much of itself, held over each interval."""
        d, e = self._unit(of_wind(placed), SWELL_STEP)
        return d[..., None] * parts[:, :, None], e[..., None] * parts[:, :, None]

    def moments(self) -> Float[np.ndarray, "S K points"]:
        """Times inside every interval."""
        time = self.problem.segments.time
        return time[:, :-1, None] + INSIDE * np.diff(time, axis=1)[..., None]

    def _unit(self, probe: Probe, step: float) -> tuple[np.ndarray, np.ndarray]:
        """d and e of one unit of a probe, by a small step; found once."""
        if probe.key not in self._units:
            d, e = self.defects([(probe.placed, probe.values(step))])
            self._units[probe.key] = d[..., 0] / step, e[..., 0] / step
        return self._units[probe.key]

    def pushed(
        self, effect: Effect, at: Element, trials: Sequence[Mapping[str, np.ndarray]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """d and e of an effect's forces on bodies, between samples the mean of both ends'."""
        joints, time = np.zeros((*self.path.qvel.shape, len(trials))), np.ravel(self.problem.segments.time)
        for body in bodies_of(self.problem.simulator.model, at):
            state = self.places.body_state(body, time)
            for i, p in enumerate(trials):
                torque = effect.body_torque(p, state, np) if effect.uses("body_torque") else None
                found = self.places.on_joints(body, effect.body_force(p, state, np), torque)
                joints[..., i] += found.reshape(joints.shape[:3])
        mean = 0.5 * (joints[:, :-1] + joints[:, 1:])
        parts = [self.forced(dof, mean[:, :, dof]) for dof in range(mean.shape[2]) if mean[:, :, dof].any()]
        d, e = (sum(x) for x in zip(*parts, strict=True)) if parts else self.forced(0, mean[:, :, 0])
        return np.asarray(d), np.asarray(e)

    @cached_property
    def places(self) -> Places:
        """Where all bodies are at every sample."""
        path, samples = self.path, self.path.qpos.shape[1]
        fields = {n: np.repeat(v, samples, 0) for n, v in self._fields.items() if n != "opt.timestep"}
        qpos, qvel = (x.reshape(-1, x.shape[-1]) for x in (path.qpos, path.qvel))
        return places(self.problem.simulator.model, fields, qpos, qvel)

    def joint_states(self, at: Element) -> JointState:
        """A joint at points inside every interval (S, K, points), by cubic Hermite, and what drives it."""
        key = (at.qpos, at.dof, at.actuators)
        if key not in self._inside:
            self._inside[key] = self._joint_states(at)
        if not at.source:
            return self._inside[key]
        source = Element("joint", at.source, dof=at.source_dof, qpos=at.source_qpos)
        return replace(self._inside[key], source=self.joint_states(source))

    def _joint_states(self, at: Element) -> JointState:
        time = self.problem.segments.time
        q, v = self.path.qpos[..., at.qpos], self.path.qvel[..., at.dof]
        h, u = np.diff(time, axis=1)[..., None], INSIDE
        q0, q1, v0, v1 = q[:, :-1, None], q[:, 1:, None], v[:, :-1, None], v[:, 1:, None]
        inside = (
            (1 + 2 * u) * (1 - u) ** 2 * q0
            + u * (1 - u) ** 2 * h * v0
            + u**2 * (3 - 2 * u) * q1
            + u**2 * (u - 1) * h * v1
        )
        when = self.moments()
        return JointState(inside, v0 + u * (v1 - v0), when, self._drive(at, when, u) if at.actuators else None)

    def _drive(self, at: Element, when: Float[np.ndarray, "S K points"], share: Float[np.ndarray, " points"]) -> Drive:
        model, act = self.problem.simulator.model, self.path.act
        ctrl, before = self._arriving
        step = np.floor((when - self.problem.segments.time[:, :1, None]) / self._dt + 1e-6).astype(int) + before
        ctrl = ctrl[np.arange(len(ctrl))[:, None, None], step]
        act = act[:, :-1, None] + share[:, None] * (act[:, 1:, None] - act[:, :-1, None])

        def field(name):
            own = self._fields.get(name)
            return getattr(model, name) if own is None else own[:, None, None]

        return drive_of(model, at, field, ctrl, act)

    def propagate(self, d: np.ndarray, e: np.ndarray) -> Float[np.ndarray, "S values columns"]:
        """Change of the samples (flat over samples and columns) caused by defects, starts held."""
        count, intervals = self.shape
        state = np.zeros((count, self.state_size, d.shape[-1]))
        out = np.zeros((count, intervals + 1, e.shape[2], d.shape[-1]))
        for k in range(intervals):
            out[:, k + 1] = self.c[:, k] @ state + e[:, k]
            state = self.a[:, k] @ state + d[:, k]
        return out.reshape(count, -1, d.shape[-1])
