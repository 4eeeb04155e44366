"""What the actuators of a joint are given, gathered for laws that need the torque they transmit."""

from collections.abc import Callable

import mujoco
import numpy as np

from det2stoc_bayes.mismatch.effects.base import Array, Drive, Element

FIELDS = (
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_gear",
    "actuator_forcerange",
    "actuator_ctrlrange",
    "jnt_actfrcrange",
)


def drive_of(
    model: mujoco.MjModel, at: Element, field: Callable[[str], Array], ctrl: Array, act: Array, xp=np
) -> Drive:
    """The drive of a joint under commands (..., nu) and activations (..., na).

    `field` gives the present values of one of FIELDS, simulations first; kinds and flags are the model's.
    """
    ids = np.array(at.actuators)
    affine = model.actuator_gaintype[ids] == mujoco.mjtGain.mjGAIN_AFFINE
    biased = model.actuator_biastype[ids] == mujoco.mjtBias.mjBIAS_AFFINE
    slope = np.array([0.0, 1, 1])  # a fixed gain has its first coefficient alone
    gain = field("actuator_gainprm")[..., ids, :3] * np.where(affine[:, None], 1.0, 1 - slope)
    bias = field("actuator_biasprm")[..., ids, :3] * biased[:, None]
    low, high = _limits(field("actuator_forcerange")[..., ids, :], model.actuator_forcelimited[ids], xp)
    joint = int(model.dof_jntid[at.dof])
    total = _limits(field("jnt_actfrcrange")[..., joint, :], model.jnt_actfrclimited[joint], xp)
    gear = field("actuator_gear")[..., ids, 0]
    return Drive(gain, bias, gear, low, high, _inputs(model, ids, field, ctrl, act, xp), *total)


def _inputs(model, ids, field, ctrl, act, xp) -> Array:
    """A command within its range, or the activation where there is one."""
    clamped = model.actuator_ctrllimited[ids].astype(bool)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        clamped = np.zeros_like(clamped)
    low, high = _limits(field("actuator_ctrlrange")[..., ids, :], clamped, xp)
    command = xp.clip(ctrl[..., model.actuator_ctrladr[ids]], low, high)
    if not model.na:
        return command
    # The last of an actuator's activations is the one that acts.
    last = model.actuator_actadr[ids] + model.actuator_actnum[ids] - 1
    return xp.where(model.actuator_actnum[ids] > 0, act[..., np.maximum(last, 0)], command)


def _limits(ranges: Array, limited: Array, xp) -> tuple[Array, Array]:
    on = np.asarray(limited, bool)
    return xp.where(on, ranges[..., 0], -np.inf), xp.where(on, ranges[..., 1], np.inf)
