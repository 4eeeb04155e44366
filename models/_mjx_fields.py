"""What psi sets of a scene, and what MuJoCo derives from it, as arrays over simulations for MJX."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

FIELDS = ("pair_friction", "body_pos", "body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0")


def stacked_fields(models: Sequence[mujoco.MjModel]) -> dict[str, jax.Array]:
    """FIELDS of models that differ in psi alone, a row a model."""
    return {name: jnp.asarray(np.stack([getattr(m, name) for m in models])) for name in FIELDS}
