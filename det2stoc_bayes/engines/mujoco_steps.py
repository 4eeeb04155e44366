"""Single steps of a batch, with forces and model fields that depend on the state."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.engines import drive
from det2stoc_bayes.engines.base import EffectRows
from det2stoc_bayes.engines.layout import integrate_positions
from det2stoc_bayes.engines.places import DERIVED, Body, bodies_of, body_of, body_state
from det2stoc_bayes.mismatch.effects.base import BodyState, JointState

_NONE, _VEL = mujoco.mjtStage.mjSTAGE_NONE, mujoco.mjtStage.mjSTAGE_VEL


def is_stepped(e: EffectRows) -> bool:
    """Whether the effect needs the state at every step."""
    effect = e.placed.effect
    return bool(effect.writes) or effect.uses("body_force") or (effect.uses("joint_force") and not effect.changes)


class Stepper:
    """Steps a batch under effects. `time` (sims) is the recorded clock's."""

    def __init__(self, model: mujoco.MjModel, batch: Any, effects: Sequence[EffectRows], time: np.ndarray):
        self.model, self.batch, self.dt = model, batch, model.opt.timestep
        self.begin, self.time = time, np.array(time)
        self.share = np.ones_like(time)  # of a timestep that the next step lasts
        stepped = [e for e in effects if is_stepped(e)]
        self.momentary = [e for e in stepped if e.placed.effect.writes]
        self.pushed = [e for e in stepped if e.placed.effect.uses("body_force")]
        self.bodies = {id(e): [body_of(model, b) for b in bodies_of(model, e.placed.element)] for e in self.pushed}
        self.forced = [e for e in stepped if e.placed.effect.uses("joint_force")]
        # A force is held over a step. RK4 weighs the whole step, so its state is taken at the middle (a force along an
        # arm would turn it otherwise, drag would come late); the Euler integrators take every force at the beginning.
        self.middle = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        self.lead = self._lead()
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.past = np.array(self.qvel)  # speeds one step ago
        self.force, self.wrench = batch.bind("qfrc_applied"), batch.bind("xfrc_applied")
        self.ctrl = batch.bind("ctrl") if model.nu else np.zeros((len(self.qpos), 0))
        self.act = batch.bind("act") if model.na else np.zeros((len(self.qpos), 0))
        self.derived = {n: batch.bind(n) for n in DERIVED if n != "cdof"} if self.pushed else {}
        self.shaped = self._shaped()
        self.fields = self._expanded()
        self.believed = {n: self.fields[n].copy() for e in self.momentary for n in e.placed.effect.writes}
        self.laws: dict[int, drive.DriveLaw] = {}
        remembering = [e for e in self.forced if e.placed.effect.uses("anchor")]
        self.anchors = {id(e): np.array(self.qpos[e.rows, e.placed.element.qpos]) for e in remembering}
        self.history: list[dict[int, np.ndarray]] = []  # anchors of every step

    def _expanded(self) -> dict[str, np.ndarray]:
        driven = any("driven" in e.placed.effect.needs for e in self.forced)
        names: set[str] = set(drive.FIELDS) if driven else set()
        for e in self.momentary:
            names |= {*e.placed.effect.writes, *e.placed.effect.reads}
            names |= set(drive.FIELDS) if "driven" in e.placed.effect.needs else set()
        return {name: self.batch.expand(name) for name in sorted(names)}

    def run(
        self, commands: Float[np.ndarray, "sims _ nu"], items: Sequence[str], *, closing: bool = True
    ) -> dict[str, Float[np.ndarray, "sims steps _"]]:
        """Arrays after every step, sensors as they are before it; commands reach one step beyond the last.

        `closing`: forces are those of the last state then, as its sensors want them.
        """
        batch, num_steps = self.batch, commands.shape[1] - 1
        live = {name: batch.bind(name) for name in items}
        out = {name: np.empty((len(self.qpos), num_steps, array.shape[1])) for name, array in live.items()}
        ahead = bool(self.pushed) and not self.momentary  # else `prepare` places bodies, under the coming step's fields
        # The stages of the new state would overwrite its sensors, those of the middle are not the ones to step from.
        apart = ahead and ("sensordata" in live or self.middle)
        stage = _VEL if ahead and not apart else _NONE
        if ahead:
            self._place()
        for k in range(num_steps):
            self.prepare(commands[:, k])
            self._keep()
            self.past[:] = self.qvel
            wanted = closing or k + 1 < num_steps  # by what comes after the step
            batch.step(stage=stage if wanted else _NONE)
            self.time += self.dt
            for name, array in live.items():
                out[name][:, k] = array
            if apart and wanted:
                self._place()
        if closing:
            self.prepare(commands[:, num_steps])
            self._keep()
        return out

    def _keep(self) -> None:
        if self.anchors:
            self.history.append(dict(self.anchors))

    def _recall(self, step: Int[np.ndarray, " sims"]) -> None:
        """Anchors as they were at a step of each simulation."""
        for e in self.forced:
            if id(e) in self.anchors:
                kept = np.stack([anchors[id(e)] for anchors in self.history])
                self.anchors[id(e)] = kept[step[e.rows], np.arange(kept.shape[1])]

    def part(
        self,
        command: Float[np.ndarray, "sims nu"],
        past: Float[np.ndarray, "sims nv"],
        num_done: Int[np.ndarray, " sims"],
        share: Float[np.ndarray, " sims"],
        then: Float[np.ndarray, "sims nu"] | None = None,
    ) -> None:
        """A step that lasts a share of a timestep, which the batch has been told; `past` are speeds one step ago.

        With a command for `then` all is ready for the sensors where it ended.
        """
        self._recall(num_done)
        self._stand(past, num_done, share)
        self.prepare(command)
        past = np.array(self.qvel)
        self.batch.step(stage=_NONE)
        if then is not None:
            self._stand(past, num_done + share, np.ones_like(share))
            self.prepare(then)

    def _stand(self, past: np.ndarray, num_done: np.ndarray, share: np.ndarray) -> None:
        """What the coming step looks at, so many steps after the start."""
        self.past[:], self.time[:], self.share = past, self.begin + num_done * self.dt, share
        self.lead = self._lead()
        if self.pushed and not self.momentary:
            self._place()

    def prepare(self, command: Float[np.ndarray, "sims nu"]) -> None:
        """Command, fields and forces of the step that begins."""
        self.force[:], self.wrench[:], self.ctrl[:] = 0.0, 0.0, command
        for name, value in self.believed.items():
            self.fields[name][:] = value
        for e in self.momentary:
            effect, names = e.placed.effect, (*e.placed.effect.writes, *e.placed.effect.reads)
            inside = {n: self.fields[n][e.rows] for n in names}
            changed = effect.momentary(e.parameters, inside, self._joint_state(e), e.placed.element, np)
            for name, value in changed.items():
                self.fields[name][e.rows] = value
        if self.momentary and self.pushed:
            self._place()  # a batch that keeps its stages would step with the fields before
        for e in self.forced:
            effect, at, state = e.placed.effect, e.placed.element, self._joint_state(e)
            if id(e) in self.anchors:
                self.anchors[id(e)] = effect.anchor(e.parameters, state.q, self.anchors[id(e)], np)
                state = replace(state, anchor=self.anchors[id(e)])
            self.force[e.rows, at.dof] += effect.joint_force(e.parameters, state, np)
            if at.source:
                self.force[e.rows, at.source_dof] += effect.reaction(e.parameters, state, np)
        for e in self.pushed:
            for body in self.bodies[id(e)]:
                effect, state = e.placed.effect, self._body_state(e, body)
                self.wrench[e.rows, body.number, :3] += effect.body_force(e.parameters, state, np)
                if effect.uses("body_torque"):
                    self.wrench[e.rows, body.number, 3:] += effect.body_torque(e.parameters, state, np)

    def _place(self) -> None:
        """Velocities and places of bodies for the step that begins; RK4's in its middle."""
        if not self.middle:
            self.batch.forward(stage=_VEL)
            return
        qpos, qvel, middle = np.array(self.qpos), np.array(self.qvel), self._speeds()
        self.qpos[:] = integrate_positions(self.model, qpos, self.lead[:, None] * 0.5 * (qvel + middle))
        self.qvel[:] = middle
        self.batch.forward(stage=_VEL)
        self.qpos[:], self.qvel[:] = qpos, qvel

    def _lead(self) -> Float[np.ndarray, " sims"]:
        """Seconds from the step's beginning to where its forces are taken."""
        return 0.5 * self.middle * self.share * self.dt

    def _speeds(self, dof: int | slice = slice(None)) -> np.ndarray:
        """Speeds where the step's forces are taken, as the last step's change foretells them."""
        now = self.qvel[:, dof]
        if not self.middle:
            return now
        share = self.share if now.ndim == 1 else self.share[:, None]
        return now + 0.5 * share * (now - self.past[:, dof])

    def _joint_state(self, e: EffectRows) -> JointState:
        at, rows, time = e.placed.element, e.rows, self.time[e.rows] + self.lead[e.rows]
        if at.dof < 0:
            return JointState(0.0 * time, 0.0 * time, time)
        if at.kind == "contact":  # where its free body is
            return JointState(self.qpos[rows, at.qpos : at.qpos + 3], self.qvel[rows, at.dof : at.dof + 3], time)
        given = None
        if at.actuators and "driven" in e.placed.effect.needs:
            given = self._law(e)(self.ctrl[rows], self.act[rows])
        other = JointState(*self._motion(at.source_qpos, at.source_dof, rows), time) if at.source else None
        return JointState(*self._motion(at.qpos, at.dof, rows), time, given, other)

    def _motion(self, qpos: int, dof: int, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Position and speed where the step's forces are taken."""
        speed = self._speeds(dof)[rows]
        return self.qpos[rows, qpos] + self.lead[rows] * 0.5 * (self.qvel[rows, dof] + speed), speed

    def _law(self, e: EffectRows) -> drive.DriveLaw:
        """The law of what drives the effect's joint, found once unless some effect rewrites it at every step."""
        key = id(e)
        if key not in self.laws or not self.believed.keys().isdisjoint(drive.FIELDS):
            at, rows = e.placed.element, e.rows
            self.laws[key] = drive.law_of(self.model, at, lambda name: self.fields[name][rows].copy())
        return self.laws[key]

    def _body_state(self, e: EffectRows, body: Body) -> BodyState:
        rows = e.rows
        derived, shaped = ({n: a[rows] for n, a in arrays.items()} for arrays in (self.derived, self.shaped))
        heavy = e.placed.effect.uses("body_torque")
        return body_state(body, derived, shaped, self.time[rows] + self.lead[rows], heavy)

    def _shaped(self) -> dict[str, np.ndarray]:
        """Fields that forces on bodies look at, simulations first."""
        sized = any(e.placed.element.traits & {"sized"} for e in self.pushed)
        heavy = any(e.placed.effect.uses("body_torque") for e in self.pushed)
        own = {"geom_size": sized, "body_mass": heavy, "body_inertia": heavy}
        count = len(self.time)
        alike = {n: np.broadcast_to(getattr(self.model, n), (count, *getattr(self.model, n).shape)) for n in own}
        return {n: self.batch.expand(n) if on else alike[n] for n, on in own.items()}
