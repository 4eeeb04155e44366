"""Windy Slope for GPUs: the same scene in MJX, whose round post is a prism there (MJX has no box against cylinder)."""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.models._mjx_fields import stacked_fields
from det2stoc_bayes.models.windy_slope import MODEL, NUM_STEPS, SUBSTEPS, prepared, write_state

SIDES = 16  # of the prism, whose corners lie on the post


def prism_model(sides: int = SIDES) -> mujoco.MjModel:
    """The scene with a prism for a post."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    post = spec.geom("post")
    radius, half = post.size[:2]
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    corners = [np.column_stack([ring, np.full(sides, z)]) for z in (-half, half)]
    spec.add_mesh(name="prism", uservert=np.concatenate(corners).ravel())
    post.type, post.meshname = mujoco.mjtGeom.mjGEOM_MESH, "prism"
    return spec.compile()


def simulate(
    psi: Float[np.ndarray, "episodes 3"], *, num_steps: int = NUM_STEPS, sides: int = SIDES
) -> Float[np.ndarray, "episodes samples 18"]:
    """States of episodes, the initial one first; all at once, in the precision that jax is set to."""
    model = prism_model(sides)
    batch = prepared(model, psi, 0)
    models = [batch.get_model(i) for i in range(len(psi))]
    fields = stacked_fields(models)
    wind = jnp.asarray(np.stack([m.opt.wind for m in models]))
    run = _rollouts(sides, num_steps, jax.config.jax_enable_x64)
    qpos, qvel = (np.asarray(a) for a in run(fields, wind))
    out = np.empty((len(psi), num_steps + 1, 18))
    for k in range(num_steps + 1):
        write_state(qpos[:, k], qvel[:, k], out[:, k])
    return out


@cache
def _rollouts(sides: int, num_steps: int, double: bool) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """qpos and qvel of episodes, compiled for a precision: arrays of the model are of it."""
    from mujoco import mjx

    plain = mjx.put_model(prism_model(sides))

    def one(fields, wind):
        model = plain.replace(**fields, opt=plain.opt.replace(wind=wind))

        def sample(data, _):
            after = jax.lax.fori_loop(0, SUBSTEPS, lambda _, d: mjx.step(model, d), data)
            return after, (after.qpos, after.qvel)

        first = mjx.make_data(plain)
        _, (qpos, qvel) = jax.lax.scan(sample, first, None, length=num_steps)
        return jnp.concatenate([first.qpos[None], qpos]), jnp.concatenate([first.qvel[None], qvel])

    return jax.jit(jax.vmap(one))
