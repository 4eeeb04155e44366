"""Where recorded columns sit in a compiled model's arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.rotations import rotated

POSITION_PARTS = {"x": 0, "y": 1, "z": 2, "qw": 3, "qx": 4, "qy": 5, "qz": 6}
VELOCITY_PARTS = {"vx": 0, "vy": 1, "vz": 2, "wx": 3, "wy": 4, "wz": 5}
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_ROTATIONAL = ("qw", "qx", "qy", "qz", "wx", "wy", "wz")

LONGEST_BEND = 10  # steps before the first one over which three steps' curvature says something


@dataclass(frozen=True)
class ColumnAddress:
    """Which array of a simulation's data a column is, and where: `source` is qpos, qvel or sensordata."""

    source: str
    index: int
    unit: str


def column_address(model: mujoco.MjModel, column: str) -> ColumnAddress:
    """Address of `qpos/<joint>[/<part>]`, `qvel/<joint>[/<part>]` or `sensor/<name>[/<i>]`; names may hold slashes."""
    source, _, rest = column.partition("/")
    if source == "sensor":
        number, part = _element_and_part(model, mujoco.mjtObj.mjOBJ_SENSOR, rest)
        return ColumnAddress("sensordata", int(model.sensor_adr[number]) + int(part or 0), "")
    number, part = _element_and_part(model, mujoco.mjtObj.mjOBJ_JOINT, rest)
    joint, kind = model.joint(number), int(model.jnt_type[number])
    if not part:
        unit = "rad" if kind == HINGE else "m"
        address = joint.qposadr[0] if source == "qpos" else joint.dofadr[0]
        return ColumnAddress(source, int(address), unit if source == "qpos" else f"{unit}/s")
    parts = POSITION_PARTS if source == "qpos" else VELOCITY_PARTS
    shift = 0 if kind == FREE else 3
    base = joint.qposadr[0] if source == "qpos" else joint.dofadr[0]
    unit = "1" if part.startswith("q") else "rad" if part in _ROTATIONAL else "m"
    return ColumnAddress(source, int(base) + parts[part] - shift, unit if source == "qpos" else f"{unit}/s")


def _element_and_part(model: mujoco.MjModel, kind: mujoco.mjtObj, rest: str) -> tuple[int, str]:
    """Number of the element that is named in `<name>` or `<name>/<part>`, and the part."""
    whole = mujoco.mj_name2id(model, kind, rest)
    if whole >= 0:
        return whole, ""
    name, _, part = rest.rpartition("/")
    number = mujoco.mj_name2id(model, kind, name)
    if number < 0:
        raise KeyError(f"the model has neither '{rest}' nor '{name}'")
    return number, part


def quaternion_groups(columns: Sequence[str], quaternions: Sequence[Sequence[str]]) -> list[list[int]]:
    """Indices of the four components of every fully recorded quaternion; `quaternions` are a model's columns."""
    return [[columns.index(c) for c in group] for group in quaternions if set(group) <= set(columns)]


def integrate_positions(
    model: mujoco.MjModel, qpos: Float[np.ndarray, "sims nq"], change: Float[np.ndarray, "sims nv"]
) -> Float[np.ndarray, "sims nq"]:
    """Positions moved along tangent vectors, as mj_integratePos does."""
    if model.nq == model.nv:
        return qpos + change
    out = np.array(qpos)
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind in (SLIDE, HINGE):
            out[:, q] += change[:, v]
            continue
        if kind == FREE:
            out[:, q : q + 3] += change[:, v : v + 3]
            q, v = q + 3, v + 3
        out[:, q : q + 4] = rotated(out[:, q : q + 4], change[:, v : v + 3])
    return out


def position_difference(
    model: mujoco.MjModel, origin: Float[np.ndarray, "sims nq"], qpos: Float[np.ndarray, "sims nq"]
) -> Float[np.ndarray, "sims nv"]:
    """Tangent vectors that lead from `origin` to `qpos`; inverse of `integrate_positions`."""
    if model.nq == model.nv:
        return qpos - origin
    out = np.empty((len(qpos), model.nv))
    for row, a, b in zip(out, origin, qpos, strict=True):
        mujoco.mj_differentiatePos(model, row, 1.0, np.ascontiguousarray(a), np.ascontiguousarray(b))
    return out
