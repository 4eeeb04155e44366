"""Where recorded columns sit in a compiled model's arrays."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

POSITION_PARTS = {"x": 0, "y": 1, "z": 2, "qw": 3, "qx": 4, "qy": 5, "qz": 6}
VELOCITY_PARTS = {"vx": 0, "vy": 1, "vz": 2, "wx": 3, "wy": 4, "wz": 5}
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_ROTATIONAL = ("qw", "qx", "qy", "qz", "wx", "wy", "wz")


@dataclass(frozen=True)
class ColumnAddress:
    """Which array of a simulation's data a column is, and where: `source` is qpos, qvel or sensordata."""

    source: str
    index: int
    unit: str


def column_address(model: mujoco.MjModel, column: str) -> ColumnAddress:
    """Address of `qpos/<joint>[/<part>]`, `qvel/<joint>[/<part>]` or `sensor/<name>[/<i>]`."""
    source, name, *rest = column.split("/")
    if source == "sensor":
        sensor = model.sensor(name)
        return ColumnAddress("sensordata", int(sensor.adr[0]) + int(rest[0] if rest else 0), "")
    joint = model.joint(name)
    kind = int(model.jnt_type[joint.id])
    if not rest:
        unit = "rad" if kind == HINGE else "m"
        address = joint.qposadr[0] if source == "qpos" else joint.dofadr[0]
        return ColumnAddress(source, int(address), unit if source == "qpos" else f"{unit}/s")
    parts = POSITION_PARTS if source == "qpos" else VELOCITY_PARTS
    shift = 0 if kind == FREE else 3
    base = joint.qposadr[0] if source == "qpos" else joint.dofadr[0]
    unit = "1" if rest[0].startswith("q") else "rad" if rest[0] in _ROTATIONAL else "m"
    return ColumnAddress(source, int(base) + parts[rest[0]] - shift, unit if source == "qpos" else f"{unit}/s")


def quaternion_groups(columns: tuple[str, ...]) -> list[list[int]]:
    """Indices of the four components of every fully recorded quaternion."""
    groups = []
    for i, column in enumerate(columns):
        stem, _, part = column.rpartition("/")
        if part == "qw" and all(f"{stem}/{p}" in columns for p in ("qx", "qy", "qz")):
            groups.append([i] + [columns.index(f"{stem}/{p}") for p in ("qx", "qy", "qz")])
    return groups


def integrate_positions(
    model: mujoco.MjModel, qpos: Float[np.ndarray, "sims nq"], change: Float[np.ndarray, "sims nv"]
) -> Float[np.ndarray, "sims nq"]:
    """Positions moved along tangent vectors (quaternions by mj_integratePos)."""
    if model.nq == model.nv:
        return qpos + change
    out = np.array(qpos)
    for row, step in zip(out, change, strict=True):
        mujoco.mj_integratePos(model, row, np.ascontiguousarray(step), 1.0)
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
