"""The elements of a compiled model that effects can sit on."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType

import mujoco
import numpy as np

from det2stoc_bayes.engines.layout import HINGE, SLIDE, column_address
from det2stoc_bayes.mismatch.effects.base import Element

EMPTY: Mapping = MappingProxyType({})
_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
_DYNAMICS = tuple(
    int(d)
    for d in (
        mujoco.mjtDyn.mjDYN_NONE,
        mujoco.mjtDyn.mjDYN_INTEGRATOR,
        mujoco.mjtDyn.mjDYN_FILTER,
        mujoco.mjtDyn.mjDYN_FILTEREXACT,
    )
)


def joint_elements(model: mujoco.MjModel, reached: Mapping[str, tuple[float, float]] = EMPTY) -> list[Element]:
    """Named hinge and slide joints; driven where all actuators on them have a law that is known in closed form.

    `reached`: the least and the largest position of joints that were recorded.
    """
    found = []
    for j in range(model.njnt):
        joint = model.joint(j)
        if joint.name and int(model.jnt_type[j]) in (HINGE, SLIDE):
            on_it = tuple(a for a in range(len(model.actuator_trntype)) if _joint_of(model, a) == j)
            driven = bool(on_it) and all(_in_closed_form(model, a) for a in on_it)
            held = any(model.actuator_biasprm[a, 1] < 0 for a in on_it)
            traits = frozenset(t for t, on in (("driven", driven), ("held", held)) if on)
            rest = float(model.qpos0[model.jnt_qposadr[j]])
            reach = reached.get(joint.name, (rest, rest))
            found.append(_on_joint(model, j, "joint", joint.name, actuators=on_it, traits=traits, reach=reach))
    return found


def actuator_elements(model: mujoco.MjModel) -> list[Element]:
    """Named actuators with one control each; driven where they drive a hinge or slide joint."""
    found = []
    for a in range(len(model.actuator_trntype)):
        name = model.actuator(a).name
        if not name or model.actuator_ctrlnum[a] != 1:
            continue
        ctrl, joint = int(model.actuator_ctrladr[a]), _joint_of(model, a)
        if joint < 0:
            found.append(Element("actuator", name, ctrl=ctrl, actuators=(a,)))
            continue
        unit = _command_unit(model, a, int(model.jnt_type[joint]) == HINGE)
        traits = frozenset({"driven", "plain"} if _in_closed_form(model, a) else {"driven"})
        here = {"ctrl": ctrl, "actuators": (a,), "unit": unit, "traits": traits}
        found.append(_on_joint(model, joint, "actuator", name, **here))
    return found


def body_elements(model: mujoco.MjModel, resized: frozenset[int] = frozenset()) -> list[Element]:
    """Named bodies that move and have mass; `resized` are those whose size differs between recordings."""
    found = []
    for b in range(1, model.nbody):
        if model.body(b).name and model.body_weldid[b] != 0 and model.body_mass[b] > 0:
            traits = {t for t, on in (("loose", not model.body_sameframe[b]), ("sized", b in resized)) if on}
            found.append(Element("body", model.body(b).name, body=b, traits=frozenset(traits)))
    return found


def world_elements(model: mujoco.MjModel, varied: Iterable[str] = ()) -> list[Element]:
    """The world; `varied` are fields that psi or a recording sets."""
    fields, opt = set(varied), model.opt
    fluid = opt.density > 0 or opt.viscosity > 0 or fields & {"opt.density", "opt.viscosity"}
    wind = np.any(opt.wind) or "opt.wind" in fields
    return [Element("world", "world", traits=frozenset(t for t, on in (("fluid", fluid), ("wind", wind)) if on))]


def sensor_elements(model: mujoco.MjModel, columns: tuple[str, ...]) -> list[Element]:
    """Recorded columns, and the clock that stamps them."""
    value = frozenset({"value"})
    clock = Element("sensor", "time", column="time", unit="s", traits=frozenset({"clock"}))
    units = [column_address(model, c).unit for c in columns]
    return [Element("sensor", c, column=c, unit=u, traits=value) for c, u in zip(columns, units, strict=True)] + [clock]


def _on_joint(model: mujoco.MjModel, j: int, kind, name: str, **more) -> Element:
    hinge, dof, qpos = int(model.jnt_type[j]) == HINGE, int(model.jnt_dofadr[j]), int(model.jnt_qposadr[j])
    return Element(kind, name, hinge, dof, qpos, int(model.jnt_bodyid[j]), joint=j, **more)


def _joint_of(model: mujoco.MjModel, a: int) -> int:
    """The hinge or slide joint that an actuator drives, or -1."""
    if int(model.actuator_trntype[a]) not in _TRANSMISSIONS:
        return -1
    joint = int(model.actuator_trnid[a, 0])
    return joint if int(model.jnt_type[joint]) in (HINGE, SLIDE) else -1


def _in_closed_form(model: mujoco.MjModel, a: int) -> bool:
    kinds = int(model.actuator_gaintype[a]) in _GAINS and int(model.actuator_biastype[a]) in _BIASES
    return kinds and int(model.actuator_dyntype[a]) in _DYNAMICS and not model.actuator_actearly[a]


def _command_unit(model: mujoco.MjModel, a: int, hinge: bool) -> str:
    """A servo's command is a position or a speed, a motor's with gain 1 a force; others have their own."""
    bias, gain = model.actuator_biasprm[a], model.actuator_gainprm[a]
    if not _in_closed_form(model, a):
        return "1"
    if bias[1] and np.isclose(gain[0], -bias[1]):
        return "rad" if hinge else "m"
    if bias[2] and np.isclose(gain[0], -bias[2]) and not bias[1]:
        return "rad/s" if hinge else "m/s"
    return ("N m" if hinge else "N") if gain[0] == 1 and abs(model.actuator_gear[a, 0]) == 1 else "1"
