"""Where bodies are and how they move: what forces on bodies depend on, and what they come to on the joints."""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.engines.quiet import QUIET, UNTIMED
from det2stoc_bayes.mismatch.effects.base import BodyState, Element
from det2stoc_bayes.mismatch.effects.vectors import cross

DERIVED = ("cvel", "xipos", "ximat", "subtree_com", "cdof")
KINDS = ("body_mass", "body_inertia", "geom_size")  # fields that bodies' forces look at
MOST = 1024  # states derived at once


def bodies_of(model: mujoco.MjModel, at: Element) -> tuple[int, ...]:
    """The bodies that a force acts on: the element, or all that have mass if it is the world."""
    return (at.body,) if at.body > 0 else tuple(b for b in range(1, model.nbody) if model.body_mass[b] > 0)


@dataclass(frozen=True, eq=False)
class Body:
    """What of a body does not move: its number, its tree's root, its geoms and their shapes."""

    number: int
    root: int
    geoms: Int[np.ndarray, " geoms"]
    shapes: tuple[int, ...]


def body_of(model: mujoco.MjModel, number: int) -> Body:
    """A body of the model."""
    geoms = np.flatnonzero(model.geom_bodyid == number)
    return Body(number, int(model.body_rootid[number]), geoms, tuple(int(t) for t in model.geom_type[geoms]))


@dataclass(frozen=True, eq=False)
class Places:
    """MuJoCo's derived quantities of some states, and the fields of KINDS; first axis the states'."""

    model: mujoco.MjModel
    derived: Mapping[str, np.ndarray]
    fields: Mapping[str, np.ndarray]

    def body_state(self, body: int, time: Float[np.ndarray, " states"]) -> BodyState:
        """What a force on this body sees."""
        return body_state(body_of(self.model, body), self.derived, self.fields, time)

    def on_joints(
        self, body: int, force: Float[np.ndarray, "states 3"], torque: Float[np.ndarray, "states 3"] | None = None
    ) -> Float[np.ndarray, "states nv"]:
        """The generalized force of a force at the body's centre of mass, and of a torque."""
        chain, lever = np.zeros(self.model.nv, bool), _lever(body_of(self.model, body), self.derived)
        while body > 0:
            chain |= self.model.dof_bodyid == body
            body = self.model.body_parentid[body]
        axes, slides = self.derived["cdof"][..., :3], self.derived["cdof"][..., 3:]
        found = np.einsum("sdi,si->sd", slides + cross(axes, lever[:, None], np), force)
        if torque is not None:
            found = found + np.einsum("sdi,si->sd", axes, torque)
        return np.where(chain, found, 0.0)


def body_state(
    body: Body,
    derived: Mapping[str, np.ndarray],
    fields: Mapping[str, np.ndarray],
    time: Float[np.ndarray, " states"],
    heavy: bool = True,
) -> BodyState:
    """What a force on a body sees, from MuJoCo's derived quantities and the fields of KINDS, first axis the states'.

    Its inertia costs most and is wanted for torques alone: it is left out of what is not `heavy`.
    """
    own, spin = body.number, derived["cvel"][:, body.number, :3]
    velocity = derived["cvel"][:, own, 3:] + cross(spin, _lever(body, derived), np)
    inertia = 0.0
    if heavy:
        axes = derived["ximat"][:, own].reshape(-1, 3, 3)
        inertia = (axes * fields["body_inertia"][:, own, None, :]) @ np.swapaxes(axes, 1, 2)
    mass, position = fields["body_mass"][:, own], derived["xipos"][:, own]
    return BodyState(velocity, time, spin, body.shapes, fields["geom_size"][:, body.geoms], position, mass, inertia)


def _lever(body: Body, derived: Mapping[str, np.ndarray]) -> np.ndarray:
    """From the point at which MuJoCo tells velocities to the body's centre of mass."""
    return derived["xipos"][:, body.number] - derived["subtree_com"][:, body.root]


def places(
    model: mujoco.MjModel,
    fields: Mapping[str, np.ndarray],
    qpos: Float[np.ndarray, "states nq"],
    qvel: Float[np.ndarray, "states nv"],
) -> Places:
    """Derived quantities of states under model fields of their own."""
    parts = []
    for begin in range(0, len(qpos), MOST):
        rows = slice(begin, begin + MOST)
        batch = mujoco.batch.Batch(model, len(qpos[rows]), 1)
        for name, values in fields.items():
            own = batch.expand(name)
            own[:] = values[rows].reshape(own.shape)
        batch.bind("qpos")[:], batch.bind("qvel")[:] = qpos[rows], qvel[rows]
        derived = {name: batch.bind(name) for name in DERIVED}
        with QUIET, UNTIMED:
            batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        parts.append([np.array(a) for a in derived.values()])
    found: dict[str, np.ndarray] = dict(
        zip(DERIVED, (np.concatenate(a) for a in zip(*parts, strict=True)), strict=True)
    )
    return Places(model, found, {name: fields.get(name, getattr(model, name)[None]) for name in KINDS})
