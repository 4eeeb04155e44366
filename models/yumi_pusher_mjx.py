"""YuMi Pusher for GPUs: the same scene in MJX, with those contacts alone that its episodes have.

Box against table, block against table and fingers against box stay; MJX would test every pair of shapes at every step.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.models._mjx_fields import stacked_fields
from det2stoc_bayes.models.yumi_pusher import MODEL, SUBSTEPS, prepared


def reduced_model() -> mujoco.MjModel:
    """The scene with these contacts, the table's top a plane; palms, wrists and arms touch nothing."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    for geom in spec.geoms:
        if geom.classname.name != "finger":
            geom.contype = geom.conaffinity = 0
    spec.geom("box").conaffinity = 2
    table = spec.geom("table")
    top = table.pos + [0, 0, table.size[2]]
    spec.worldbody.add_geom(name="top", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], pos=top, contype=0,
                            conaffinity=0)  # fmt: skip
    for pair in spec.pairs:
        pair.geomname1 = "top"
    return spec.compile()


def simulate(
    psi: Float[np.ndarray, "sims 2"], start: Float[np.ndarray, "sims 41"], actions: Float[np.ndarray, "sims steps 14"]
) -> Float[np.ndarray, "sims samples 41"]:
    """qpos and qvel from states on, under given commands; all at once, in the precision that jax is set to."""
    batch = prepared(reduced_model(), psi)
    models = [batch.get_model(i) for i in range(len(psi))]
    fields = stacked_fields(models)
    found = _rollouts(jax.config.jax_enable_x64)(fields, jnp.asarray(start), jnp.asarray(actions))
    return np.concatenate([start[:, None], np.asarray(found)], 1)


@cache
def _rollouts(double: bool) -> Callable[..., jax.Array]:
    """Compiled for a precision: arrays of the model are of it."""
    from mujoco import mjx

    plain = mjx.put_model(reduced_model())

    def one(fields, start, actions):
        model = plain.replace(**fields)

        def sample(data, ctrl):
            data = data.replace(ctrl=ctrl)
            after = jax.lax.fori_loop(0, SUBSTEPS, lambda _, d: mjx.step(model, d), data)
            return after, jnp.concatenate([after.qpos, after.qvel])

        first = mjx.make_data(plain).replace(qpos=start[: plain.nq], qvel=start[plain.nq :])
        return jax.lax.scan(sample, first, actions)[1]

    return jax.jit(jax.vmap(one))
