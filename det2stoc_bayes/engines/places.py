"""Where bodies are and how they move: what forces on bodies depend on, and what they come to on the joints."""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.effects.base import BodyState, Element

DERIVED = ("cvel", "xipos", "subtree_com", "cdof")
MOST = 1024  # states derived at once


@dataclass(frozen=True, eq=False)
class Places:
    """MuJoCo's derived quantities of some states, first axis the states'."""

    model: mujoco.MjModel
    cvel: Float[np.ndarray, "states bodies 6"]
    xipos: Float[np.ndarray, "states bodies 3"]
    subtree_com: Float[np.ndarray, "states bodies 3"]
    cdof: Float[np.ndarray, "states nv 6"]
    sizes: Float[np.ndarray, "states geoms 3"]

    def body_state(self, at: Element, time: Float[np.ndarray, " states"]) -> BodyState:
        """What a force on this body sees."""
        return body_state(self.model, at, self.cvel, self.xipos, self.subtree_com, self.sizes, time)

    def on_joints(self, at: Element, force: Float[np.ndarray, "states 3"]) -> Float[np.ndarray, "states nv"]:
        """The generalized force of a force at the body's centre of mass."""
        chain, body = np.zeros(self.model.nv, bool), at.body
        while body > 0:
            chain |= self.model.dof_bodyid == body
            body = self.model.body_parentid[body]
        axes, slides = self.cdof[..., :3], self.cdof[..., 3:]
        moved = slides + np.cross(axes, _lever(self.model, at, self.xipos, self.subtree_com)[:, None])
        return np.where(chain, np.einsum("sdi,si->sd", moved, force), 0.0)


def body_state(
    model: mujoco.MjModel,
    at: Element,
    cvel: Float[np.ndarray, "states bodies 6"],
    xipos: Float[np.ndarray, "states bodies 3"],
    subtree_com: Float[np.ndarray, "states bodies 3"],
    sizes: Float[np.ndarray, "#states geoms 3"],
    time: Float[np.ndarray, " states"],
) -> BodyState:
    """What a force on a body sees, from MuJoCo's derived quantities."""
    spin, geoms = cvel[:, at.body, :3], np.flatnonzero(model.geom_bodyid == at.body)
    velocity = cvel[:, at.body, 3:] + np.cross(spin, _lever(model, at, xipos, subtree_com))
    shapes = tuple(int(t) for t in model.geom_type[geoms])
    return BodyState(velocity, time, spin, shapes, sizes[:, geoms])


def _lever(model: mujoco.MjModel, at: Element, xipos: np.ndarray, subtree_com: np.ndarray) -> np.ndarray:
    """From the point at which MuJoCo tells velocities to the body's centre of mass."""
    return xipos[:, at.body] - subtree_com[:, model.body_rootid[at.body]]


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
        batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        parts.append([np.array(a) for a in derived.values()])
    sizes = np.broadcast_to(fields.get("geom_size", model.geom_size), (len(qpos), model.ngeom, 3))
    cvel, xipos, subtree_com, cdof = (np.concatenate(a) for a in zip(*parts, strict=True))
    return Places(model, cvel, xipos, subtree_com, cdof, sizes)
