"""MuJoCo's full physics state, as other tools store it, from recorded columns."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.model_names import joint_columns

if TYPE_CHECKING:
    import mujoco


def full_state(
    model: "mujoco.MjModel", time: float, columns: Mapping[str, float]
) -> tuple[Float[np.ndarray, " state"], list[str]]:
    """mjSTATE_FULLPHYSICS with the given positions and velocities, and the columns that stay as in the model."""
    import mujoco

    data, missing = mujoco.MjData(model), []
    data.time = time
    for joint in map(model.joint, range(model.njnt)):
        told = joint_columns(joint.name, joint.type[0])
        for kind, values, first in (("qpos", data.qpos, joint.qposadr[0]), ("qvel", data.qvel, joint.dofadr[0])):
            for i, column in enumerate(c for c in told if c.startswith(f"{kind}/")):
                if column in columns:
                    values[first + i] = columns[column]
                else:
                    missing.append(column)
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS.value))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
    return state, missing
