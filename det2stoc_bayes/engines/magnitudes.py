"""Typical forces, speeds and travels in a model's own simulation."""

from typing import Any

import mujoco
import numpy as np

from det2stoc_bayes.engines.layout import column_address
from det2stoc_bayes.mismatch.effects.base import Element, Typical
from det2stoc_bayes.problem import Problem

NUM_PLACES = 60  # where a contact's body was
MAX_STEPS = 4000  # of the simulation that is looked at


class Magnitudes:
    """The believed model at its prior's median, simulated from the recordings' starts under the recorded commands."""

    def __init__(self, problem: Problem):
        self.problem, self.model = problem, problem.simulator.model
        self._track = {
            name: [] for name in ("qpos", "qvel", "force", "inertia", "body_speed", "body_spin", "body_force", "place")
        } | {name: [] for name in ("sensordata", "ctrl", "actuator_force", "actuator_velocity")}
        segments = problem.segments
        some = range(0, segments.count, max(1, segments.count // 12))
        steps = max(MAX_STEPS // len(some), 50)
        commands = segments.commands(np.arange(segments.count), self.model.opt.timestep, steps).each
        model = self._at_median()
        for s in some:
            self._simulate(model, s, min(steps, int(segments.steps(model.opt.timestep)[s])), commands[s])
        self.arrays = {name: np.array(rows) for name, rows in self._track.items()}

    def _at_median(self) -> mujoco.MjModel:
        batch = mujoco.batch.Batch(self.model, 1)
        psi = self.problem.psi(np.zeros((1, self.problem.size)))
        for name, value in self.problem.simulator.fields(psi, [""]).items():
            batch.expand(name)[:] = value
        batch.set_const()
        return batch.get_model(0)

    def _simulate(self, model: mujoco.MjModel, s: int, steps: int, command: np.ndarray) -> None:
        data = mujoco.MjData(model)
        start = self.problem.guess.start
        data.qpos[:], data.qvel[:] = start.qpos[s], start.qvel[s]
        full, velocity = np.empty((model.nv, model.nv)), np.empty(6)
        for k in range(steps):
            data.ctrl[:] = command[k]
            mujoco.mj_step(model, data)
            mujoco.mj_rnePostConstraint(model, data)  # or there are no accelerations of bodies
            if not np.isfinite(data.qvel).all() or np.abs(data.qvel).max(initial=0) > 1e6:
                return
            mujoco.mj_fullM(model, data, full)
            parts = (data.qfrc_actuator, data.qfrc_passive, data.qfrc_bias)
            row = {
                "qpos": data.qpos,
                "qvel": data.qvel,
                "force": np.sqrt(sum(p**2 for p in parts)),
                "inertia": np.diag(full),
                "sensordata": data.sensordata,
                "ctrl": data.ctrl,
                "actuator_force": data.actuator_force,
                "actuator_velocity": data.actuator_velocity,
            }
            speeds = []
            for b in range(model.nbody):
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, b, velocity, 0)
                speeds.append((np.linalg.norm(velocity[3:]), np.linalg.norm(velocity[:3])))
            row["place"] = data.xipos
            row["body_speed"], row["body_spin"] = np.array(speeds).T
            row["body_force"] = model.body_mass * np.linalg.norm(data.cacc[:, 3:], axis=1)
            for name, value in row.items():
                self._track[name].append(np.array(value))

    def of(self, element: Element) -> Typical:
        """Root mean squares over the simulation (span: half the range), with floors for what hardly moves."""
        segments = self.problem.segments
        intervals = np.diff(segments.time, axis=1)
        base = {
            "duration": float(max(np.ptp(r.time) for r in segments.recordings)),
            "sampling": float(np.median(intervals[intervals > 0])),
            "timestep": float(self.model.opt.timestep),
            "integrator": mujoco.mjtIntegrator(self.model.opt.integrator).name.removeprefix("mjINT_"),
        }
        own = {"joint": self._joint, "body": self._body, "actuator": self._actuator, "world": self._world}
        own["contact"] = self._contact
        if element.kind in own:
            return Typical(**own[element.kind](element), **base)
        if element.kind == "sensor" and element.column != "time":
            where = column_address(self.model, element.column)
            return Typical(span=max(self._span(where.source, where.index), 1e-6), **base)
        return Typical(**base)

    def _joint(self, element: Element) -> dict[str, Any]:
        inertia = max(self._rms("inertia", element.dof), 1e-9)
        speed = max(self._rms("qvel", element.dof), 1e-2)
        span = max(self._span("qpos", element.qpos), 1e-2)
        force = max(self._rms("force", element.dof), 0.1 * inertia * speed**2 / span)
        low, high = element.reach
        reach = (low, high) if high > low else (low - span, high + span)
        return {"force": force, "speed": speed, "span": span, "inertia": inertia, "reach": reach}

    def _body(self, element: Element) -> dict[str, Any]:
        b, places = element.body, self.arrays["place"]
        middle = places[:, b].mean(0) if len(places) else np.zeros(3)
        way = float(np.sqrt(np.mean(np.sum((places[:, b] - middle) ** 2, -1)))) if len(places) else 0.0
        mass = max(float(self.model.body_mass[b]), 1e-9)
        # What is welded to it moves with it: a load of a light shell may be as heavy as what the shell holds.
        whole = max(float(self.model.body_mass[self.model.body_weldid == self.model.body_weldid[b]].sum()), mass)
        gravity = float(np.linalg.norm(self.model.opt.gravity))
        return {
            "force": max(whole / mass * self._rms("body_force", b), whole * max(gravity, 1.0)),
            "speed": max(self._rms("body_speed", b), 1e-2),
            "spin": max(self._rms("body_spin", b), 1e-1),
            "span": max(float(np.sqrt(self.model.body_inertia[b].sum() / (2 * mass))), 1e-3),
            "inertia": whole,
            "place": tuple(middle.tolist()),
            "way": max(way, 1e-2),
            "density": float(self.model.opt.density),
        }

    def _actuator(self, element: Element) -> dict[str, float]:
        (a,), command = element.actuators, max(self._peak("ctrl", element.ctrl), 1e-6)
        force, speed = max(self._rms("actuator_force", a), 1e-6), max(self._rms("actuator_velocity", a), 1e-2)
        return {
            "force": force,
            "peak_force": max(self._peak("actuator_force", a), force),
            "speed": speed,
            "peak_speed": max(self._peak("actuator_velocity", a), speed),
            "command": command,
        }

    def _contact(self, element: Element) -> dict[str, Any]:
        found: dict[str, Any] = self._body(element) if element.body >= 0 else {}
        refs = self.model.geom_solref[list(element.geoms)]
        ref = self.model.pair_solref[element.pair] if element.pair >= 0 else refs.mean(0)
        if "free" in element.traits and len(self.arrays["qpos"]):
            places = self.arrays["qpos"][:, element.qpos : element.qpos + 3]
            chosen = places[np.linspace(0, len(places) - 1, NUM_PLACES).astype(int)]
            found |= {"region": tuple(tuple(float(v) for v in row) for row in chosen)}
        return found | {"solref": (float(ref[0]), float(ref[1]))}

    def _world(self, element: Element) -> dict[str, float]:
        moving = max((self._rms("body_speed", b) for b in range(self.model.nbody)), default=0.0)
        wind, gravity = (float(np.linalg.norm(x)) for x in (self.model.opt.wind, self.model.opt.gravity))
        return {"force": gravity, "speed": max(wind, moving, 0.1)}

    def _peak(self, name: str, index: int) -> float:
        values = self.arrays[name]
        return float(np.abs(values[:, index]).max()) if len(values) else 0.0

    def _rms(self, name: str, index: int) -> float:
        values = self.arrays[name]
        return float(np.sqrt(np.mean(values[:, index] ** 2))) if len(values) else 0.0

    def _span(self, name: str, index: int) -> float:
        values = self.arrays[name]
        return float(np.ptp(values[:, index])) / 2 if len(values) else 0.0
