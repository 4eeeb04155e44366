"""What the actuators of a joint are given, gathered for laws that need the torque they transmit."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Int

from det2stoc_bayes.mismatch.effects.base import Array, Drive, Element

FIELDS = (
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_gear",
    "actuator_forcerange",
    "actuator_ctrlrange",
    "jnt_actfrcrange",
)


@dataclass(frozen=True)
class DriveLaw:
    """All of a joint's drive but its inputs, and how these follow from commands (..., nu) and activations (..., na)."""

    rest: Drive
    commands: Int[np.ndarray, " n"]  # of each actuator, in ctrl
    activations: Int[np.ndarray, " n"] | None  # the last one of each, which acts; -1 where there is none
    low: Array
    high: Array
    xp: Any

    def __call__(self, ctrl: Array, act: Array) -> Drive:
        """A command within its range, or the activation where there is one."""
        u = self.xp.clip(ctrl[..., self.commands], self.low, self.high)
        if self.activations is not None:
            u = self.xp.where(self.activations >= 0, act[..., np.maximum(self.activations, 0)], u)
        return replace(self.rest, u=u)


def drive_of(
    model: mujoco.MjModel, at: Element, field: Callable[[str], Array], ctrl: Array, act: Array, xp=np
) -> Drive:
    """The drive of a joint under commands (..., nu) and activations (..., na); `field` as in `law_of`."""
    return law_of(model, at, field, xp)(ctrl, act)


def law_of(model: mujoco.MjModel, at: Element, field: Callable[[str], Array], xp=np) -> DriveLaw:
    """The law of a joint's drive.

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
    clamped = model.actuator_ctrllimited[ids].astype(bool)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        clamped = np.zeros_like(clamped)
    ends = _limits(field("actuator_ctrlrange")[..., ids, :], clamped, xp)
    number = model.actuator_actnum[ids]
    last = np.where(number > 0, model.actuator_actadr[ids] + number - 1, -1) if model.na else None
    rest = Drive(gain, bias, gear, low, high, None, *total)
    return DriveLaw(rest, model.actuator_ctrladr[ids], last, *ends, xp)


def _limits(ranges: Array, limited: Array, xp) -> tuple[Array, Array]:
    on = np.asarray(limited, bool)
    return xp.where(on, ranges[..., 0], -np.inf), xp.where(on, ranges[..., 1], np.inf)
