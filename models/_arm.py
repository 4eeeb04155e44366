"""Where the end of an arm of hinges is and how it moves, for many joint positions at once."""

from dataclasses import dataclass
from typing import Self

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class Arm:
    """A chain of hinges from a body that stays, without turns between its links, and a site on what the last one holds.

    `columns`: the hinges' places among the model's degrees of freedom that `positions` are cut from by who calls.
    """

    base: Float[np.ndarray, " 3"]  # the first hinge, in the world
    offsets: Float[np.ndarray, "joints 3"]  # each link's origin in the frame of the one before; the first is 0
    axes: Float[np.ndarray, "joints 3"]
    tip: Float[np.ndarray, " 3"]  # in the last link's frame
    turn: Float[np.ndarray, "3 3"]  # of the site, in the last link's frame

    @classmethod
    def of(cls, model: mujoco.MjModel, site: str, num_joints: int) -> Self:
        """From a model's site, whose arm has that many hinges."""
        data = mujoco.MjData(model)
        data.qpos[:] = 0.0
        mujoco.mj_kinematics(model, data)
        body, bodies = int(model.site(site).bodyid[0]), []
        while len(bodies) < num_joints:
            bodies += [body] * int(model.body_jntnum[body])
            body = int(model.body_parentid[body])
        chain = bodies[::-1]
        axes = np.stack([model.jnt_axis[model.body_jntadr[b]] for b in chain])
        origins = data.xpos[chain].copy()
        tip, turn = data.site(site).xpos, data.site(site).xmat.reshape(3, 3)
        last = data.xmat[chain[-1]].reshape(3, 3)
        return cls(
            origins[0],
            np.diff(origins, axis=0, prepend=origins[:1]),
            axes,
            last.T @ (tip - origins[-1]),
            last.T @ turn,
        )

    def pose(
        self, positions: Float[np.ndarray, "sims joints"]
    ) -> tuple[Float[np.ndarray, "sims 3"], Float[np.ndarray, "sims 3 3"], Float[np.ndarray, "sims 6 joints"]]:
        """The site's place, its rotation matrix, and the Jacobian of its linear over its angular velocity (world)."""
        count, joints = positions.shape
        turn, place = np.broadcast_to(np.eye(3), (count, 3, 3)), np.broadcast_to(self.base, (count, 3))
        origins, axes = np.empty((joints, count, 3)), np.empty((joints, count, 3))
        for j in range(joints):
            place = place + turn @ self.offsets[j]
            origins[j], axes[j] = place, turn @ self.axes[j]
            turn = turn @ Rotation.from_rotvec(positions[:, j, None] * self.axes[j]).as_matrix()
        tip = place + turn @ self.tip
        linear = np.cross(axes, tip - origins)
        return tip, turn @ self.turn, np.moveaxis(np.concatenate([linear, axes], -1), 0, -1)


def damped_least_squares(
    jacobian: Float[np.ndarray, "sims rows joints"],
    wanted: Float[np.ndarray, "sims rows"],
    aside: Float[np.ndarray, "sims joints"],
    damping: float,
) -> Float[np.ndarray, "sims joints"]:
    """Joint velocities q' that min |J q' - wanted|^2 + damping^2 |q' - aside|^2 (Wampler 1986, about `aside`)."""
    across = jacobian @ np.swapaxes(jacobian, 1, 2) + damping**2 * np.eye(jacobian.shape[1])
    left = wanted - np.einsum("srj,sj->sr", jacobian, aside)
    return aside + np.einsum("srj,sr->sj", jacobian, np.linalg.solve(across, left[..., None])[..., 0])
