"""The concealed physics, written as plain code on MuJoCo's arrays; independent of every other module."""

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np


@dataclass(frozen=True)
class Effect:
    """One concealed effect: its name, the element that it acts on, its parameters in SI units."""

    name: str
    kind: str
    element: str
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Law:
    """What can be drawn: the kind of element, the size parameter, its range, and whether it takes a sign.

    `neutral` is the value of the size parameter without the effect.
    """

    kind: str
    main: str
    units: dict[str, str]
    largest: float
    signed: bool = False
    neutral: float = 0.0


JointForce = Callable[[dict[str, float], float, float], float]
Force = Callable[[mujoco.MjData], None]

JOINT_FORCES: dict[str, JointForce] = {
    "viscous_damping": lambda p, q, v: -p["coefficient"] * v,
    "quadratic_damping": lambda p, q, v: -p["coefficient"] * abs(v) * v,
    "joint_spring": lambda p, q, v: -p["stiffness"] * (q - p.get("rest", 0.0)),
    "cubic_stiffness": lambda p, q, v: -p["stiffness"] * q * q * q,
    "constant_force": lambda p, q, v: p["force"],
    "cogging_torque": lambda p, q, v: p["amplitude"] * np.sin(p["cycles"] * q + p["phase"]),
}

LAWS: dict[str, Law] = {
    "viscous_damping": Law("joint", "coefficient", {"coefficient": "N s/m|N m s/rad"}, 20.0),
    "coulomb_friction": Law("joint", "force", {"force": "N|N m"}, 20.0),
    "quadratic_damping": Law("joint", "coefficient", {"coefficient": "N s2/m2|N m s2/rad2"}, 50.0),
    "joint_spring": Law("joint", "stiffness", {"stiffness": "N/m|N m/rad"}, 100.0),
    "cubic_stiffness": Law("joint", "stiffness", {"stiffness": "N/m3|N m/rad3"}, 2000.0),
    "constant_force": Law("joint", "force", {"force": "N|N m"}, 20.0, signed=True),
    "armature": Law("joint", "inertia", {"inertia": "kg|kg m2"}, 2.0),
    "cogging_torque": Law("joint", "amplitude", {"amplitude": "N|N m", "cycles": "1/m|1/rad", "phase": "rad"}, 20.0),
    "quadratic_drag": Law("body", "coefficient", {"coefficient": "kg/m"}, 50.0),
    "actuator_delay": Law("actuator", "delay", {"delay": "s"}, 0.08),
    "actuator_gain": Law("actuator", "ratio", {"ratio": "1"}, 0.5, signed=True, neutral=1.0),
    "sensor_bias": Law("sensor", "offset", {"offset": "m|rad"}, 3.0, signed=True),
    "numerical_integration": Law("simulator", "timestep", {"timestep": "s"}, 0.0),
}


def prepare(model: mujoco.MjModel, effect: Effect | None) -> None:
    """Effects that are a field of the model: dry friction that holds at rest, reflected inertia."""
    if effect is None or effect.name not in ("coulomb_friction", "armature"):
        return
    dof = model.joint(effect.element).dofadr[0]
    if effect.name == "coulomb_friction":
        model.dof_frictionloss[dof] += effect.parameters["force"]
    else:
        model.dof_armature[dof] += effect.parameters["inertia"]
        mujoco.mj_setConst(model, mujoco.MjData(model))


def force_of(model: mujoco.MjModel, effect: Effect | None) -> Force | None:
    """A function that sets data.qfrc_applied from data.qpos and data.qvel, or None."""
    if effect is None:
        return None
    if effect.name == "quadratic_drag":
        return _drag(model, model.body(effect.element).id, effect.parameters["coefficient"])
    if effect.name not in JOINT_FORCES:
        return None
    law, parameters = JOINT_FORCES[effect.name], effect.parameters
    joint = model.joint(effect.element)
    position, dof = joint.qposadr[0], joint.dofadr[0]

    def push(data: mujoco.MjData) -> None:
        data.qfrc_applied[dof] = law(parameters, data.qpos[position], data.qvel[dof])

    return push


def _drag(model: mujoco.MjModel, body: int, coefficient: float) -> Force:
    jacobian = np.zeros((3, model.nv))

    def push(data: mujoco.MjData) -> None:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
        velocity = jacobian @ data.qvel
        data.qfrc_applied[:] = -coefficient * np.linalg.norm(velocity) * (jacobian.T @ velocity)

    return push


def pieces(
    effect: Effect | None, model: mujoco.MjModel, times: np.ndarray, commands: np.ndarray, k: int
) -> list[tuple[float, np.ndarray]]:
    """Interval k (from sample k to the next) as (duration, what the actuators receive) pieces."""
    start, stop = times[k], times[k + 1]
    if effect is not None and effect.name == "actuator_gain":
        received = commands[k].copy()
        received[model.actuator(effect.element).id] *= effect.parameters["ratio"]
        return [(stop - start, received)]
    if effect is None or effect.name != "actuator_delay":
        return [(stop - start, commands[k])]
    column, delay = model.actuator(effect.element).id, effect.parameters["delay"]
    switches = times[(times + delay > start + 1e-9) & (times + delay < stop - 1e-9)] + delay
    edges = [start, *switches, stop]
    result = []
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        middle = 0.5 * (begin + end) - delay
        received = commands[k].copy()
        received[column] = commands[max(np.searchsorted(times, middle, side="right") - 1, 0), column]
        result.append((end - begin, received))
    return result


def measure(effect: Effect | None, columns: list[str], values: np.ndarray) -> np.ndarray:
    """What the sensors record of the true (samples, columns)."""
    if effect is None or effect.name != "sensor_bias":
        return values
    recorded = values.copy()
    recorded[:, columns.index(effect.element)] += effect.parameters["offset"]
    return recorded
