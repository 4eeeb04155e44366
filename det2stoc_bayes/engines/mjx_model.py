"""A model as MJX must be given it, lest what varies be left out of the program."""

import copy
from collections.abc import Sequence

import jax.numpy as jnp
import mujoco
import numpy as np

from det2stoc_bayes.mismatch.effects.base import PlacedEffect

FAR = 1e10  # a limit that is none
COMPILED = ("actuator_forcelimited", "jnt_limited")  # flags that decide what the program contains
TINY = 1e-12  # keeps a term in the program that MJX would leave out of it where the model has 0


def with_tiny(model: mujoco.MjModel, nonzero: frozenset[tuple[str, int]]) -> mujoco.MjModel:
    """Fields that are 0 and will not stay so get a value that keeps their term in the program."""
    model = copy.copy(model)
    for name, index in nonzero:
        holder, leaf = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
        value = np.array(getattr(holder, leaf), float)
        flat = value.reshape(-1)
        flat[index] = flat[index] or TINY
        if value.ndim:
            getattr(holder, leaf)[:] = value
        else:
            setattr(holder, leaf, float(value))
    model.flg_gravcomp = bool(model.body_gravcomp.any())
    return model


def with_limits(model: mujoco.MjModel, effects: Sequence[PlacedEffect]) -> mujoco.MjModel:
    """Actuators and joints whose range effects rewrite have one, without end where the model has none."""
    model = copy.copy(model)
    for e in effects:
        if "actuator_forcerange" in e.effect.writes:
            for a in e.element.actuators:
                if not model.actuator_forcelimited[a]:
                    model.actuator_forcelimited[a], model.actuator_forcerange[a] = True, [-FAR, FAR]
        if "jnt_range" in e.effect.changes and not model.jnt_limited[e.element.joint]:
            model.jnt_limited[e.element.joint], model.jnt_range[e.element.joint] = True, [-FAR, FAR]
    return model


def braking(there, loss):
    """Friction where the program has it; a row that it has brakes like a damper where friction is 0."""
    return jnp.where(there, jnp.maximum(loss, 0.0) + TINY, loss)
