"""What a concealed law is: where it acts, how its size is drawn, and how it changes the simulation."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

Parameters = dict[str, Any]
Force = Callable[[mujoco.MjData, float], None]  # adds to data.qfrc_applied, or rewrites fields, at a time
Mapping = Callable[[mujoco.MjData, float, np.ndarray], None]  # rewrites what the actuators receive, at a time


@dataclass(frozen=True)
class Effect:
    """One concealed effect: its name, the element that it acts on, its parameters in SI units."""

    name: str
    kind: str
    element: str
    parameters: Parameters = field(default_factory=dict)


@dataclass(frozen=True)
class Scene:
    """What is typical in a system's own motion; the physical range of an effect follows from it.

    By joint: rms speed, force, travel, and the inertia; by body: force, speed, spin, extent and mass; by actuator: the
    largest command and force; by column: the spread; by contact: the share of time, and places. `duration` of a
    recording and `sampling` in s.
    """

    model: mujoco.MjModel
    duration: float
    sampling: float
    joint: dict[str, dict[str, float]]
    body: dict[str, dict[str, float]]
    actuator: dict[str, dict[str, float]]
    column: dict[str, float]
    contact: dict[str, dict[str, Any]] = field(default_factory=dict)

    def names(self, kind: str) -> list[str]:
        """Every element of a kind."""
        fixed = {"world": ["world"], "simulator": ["option"]}
        return fixed[kind] if kind in fixed else list(getattr(self, "column" if kind == "sensor" else kind))


def everywhere(scene: Scene, element: str) -> bool:
    """An effect that can act on each element of its kind."""
    return True


def in_medium(scene: Scene, element: str) -> bool:
    """Whether everything moves in a fluid."""
    return scene.model.opt.density > 0.0 or scene.model.opt.viscosity > 0.0


def nothing(rng: np.random.Generator, scene: Scene, element: str) -> Parameters:
    """No parameter beside the size."""
    return {}


@dataclass(frozen=True)
class Law:
    """One law. A size m in (0, largest] and what `draw` draws make its parameters by `value`.

    `value` must grow the effect with |m|; `signed` laws are drawn with either sign. `prepare` writes model fields;
    `push`, `receive` and `record` give functions for one element; `delay` and `lag` say how late a signal is.
    """

    kind: str
    units: dict[str, str]
    largest: Callable[[Scene, str], float]
    value: Callable[[float, Parameters], Parameters]
    draw: Callable[[np.random.Generator, Scene, str], Parameters] = nothing
    signed: bool = False
    axes: tuple[str, ...] = ()  # scalar parameters that are the components of one vector
    fits: Callable[[Scene, str], bool] = everywhere
    definite: Callable[[Scene, str], bool] = everywhere  # whether its simulation is: else it is not concealed
    prepare: Callable[[mujoco.MjModel, str, Parameters], None] | None = None
    push: Callable[[mujoco.MjModel, str, Parameters], Force] | None = None
    receive: Callable[[mujoco.MjModel, int, Parameters], Mapping] | None = None
    record: Callable[[np.ndarray, np.ndarray, Parameters], np.ndarray] | None = None
    variables: tuple[str, ...] = ()  # what a law depends on that is on no list; it is drawn only when asked for

    def parameters(self, size: float, drawn: Parameters) -> Parameters:
        """Parameters at a signed size, to four digits, so that what is told is exactly what is simulated."""
        return {key: rounded(entry) for key, entry in self.value(size, drawn).items()}


def rounded(value: Any) -> Any:
    """Four significant digits, within lists too; a name as it is."""
    if isinstance(value, str):
        return value
    return [rounded(v) for v in value] if isinstance(value, list | tuple | np.ndarray) else float(f"{value:.4g}")


def direction(rng: np.random.Generator, scene: Scene, element: str) -> Parameters:
    """A random direction in space."""
    axis = rng.standard_normal(3)
    return {"axis": axis / np.linalg.norm(axis)}


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The product of two vectors of space; numpy's is for arrays of them, and many times as slow for two."""
    out = np.zeros(3)
    mujoco.mju_cross(out, a, b)
    return out


def is_free(model: mujoco.MjModel, body: str) -> bool:
    """Whether a body flies freely."""
    index = model.body(body).id
    first = model.body_jntadr[index]
    return first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE


def motors_of(model: mujoco.MjModel, joint: str) -> list[int]:
    """The actuators that drive a joint directly."""
    index, transmission = model.joint(joint).id, mujoco.mjtTrn.mjTRN_JOINT
    return [
        a for a in range(model.nu) if model.actuator_trnid[a, 0] == index and model.actuator_trntype[a] == transmission
    ]


def actuator_force(model: mujoco.MjModel, data: mujoco.MjData, actuator: int, command: float) -> tuple[float, float]:
    """(force, what of it does not depend on the command) of an affine actuator on a joint, from qpos and qvel."""
    joint, gear = model.actuator_trnid[actuator, 0], model.actuator_gear[actuator, 0]
    length = gear * data.qpos[model.jnt_qposadr[joint]]
    speed = gear * data.qvel[model.jnt_dofadr[joint]]
    bias = model.actuator_biasprm[actuator]
    own = 0.0
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE:
        own = bias[0] + bias[1] * length + bias[2] * speed
    return model.actuator_gainprm[actuator, 0] * command + own, own
