"""Constants of a model that follow from its inertias, recomputed in MJX."""

import contextlib
import io
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

with contextlib.redirect_stdout(io.StringIO()):  # it prints that warp is missing, which nothing here uses
    from mujoco import mjx


def derived_constants(model: Any, data: Any, ancestors: np.ndarray) -> Any:
    """What mj_setConst computes from inertias and that the dynamics, limits, friction and sensors use."""
    d = mjx.com_pos(model, mjx.kinematics(model, data.replace(qpos=model.qpos0)))
    d = mjx.tendon_armature(model, mjx.crb(model, mjx.tendon(model, mjx.camlight(model, d))))
    inverse = jnp.linalg.inv(mjx.full_m(model, d)) if model.nv else jnp.zeros((0, 0))
    jacobians = jax.vmap(lambda point, body: mjx.jac(model, d, point, body))(d.xipos, jnp.arange(model.nbody))
    body = jnp.stack([jnp.einsum("bik,ij,bjk->b", j, inverse, j) / 3 for j in jacobians], -1)
    moving = jnp.asarray(model.body_weldid != 0)[:, None]
    groups = _dof_groups(model)
    tendon = jnp.einsum("ti,ij,tj->t", d._impl.ten_J, inverse, d._impl.ten_J)
    moment = mjx.transmission(model, d)._impl.actuator_moment
    return model.replace(
        body_invweight0=jnp.where(moving, body, 0.0),
        dof_invweight0=jnp.asarray(groups) @ jnp.diagonal(inverse),
        tendon_invweight0=tendon,
        actuator_acc0=jnp.linalg.norm(moment @ inverse, axis=-1) if model.nu else model.actuator_acc0,
        body_subtreemass=jnp.asarray(ancestors) @ model.body_mass,
    )


def _dof_groups(model) -> Float[np.ndarray, "nv nv"]:
    # Translations of a free joint share one weight, as do rotations of a free or ball joint.
    groups = np.eye(model.nv)
    for kind, dof in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        for shift in {0: (0, 3), 1: (0,)}.get(int(kind), ()):
            groups[dof + shift : dof + shift + 3, dof + shift : dof + shift + 3] = 1 / 3
    return groups


def ancestor_matrix(model: mujoco.MjModel) -> Float[np.ndarray, "nbody nbody"]:
    # Row b has a one for every body of b's subtree.
    out = np.eye(model.nbody)
    for body in range(model.nbody - 1, 0, -1):
        out[model.body_parentid[body]] += out[body]
    return out
