"""Which other answers name the same physics: no recording of the study can tell them apart.

Each is exact for these mechanisms, some only once psi is refitted ("mod psi").
"""

from typing import Any

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws import Effect
from det2stoc_bayes.blind.systems import System

Accepted = dict[str, Any]


def _entry(name: str, kind: str, element: str, **parameters: object) -> Accepted:
    return {"name": name, "element": {"kind": kind, "name": element}, "parameters": parameters}


def lever(model: mujoco.MjModel, joint: str) -> float:
    """Distance of a hinge's body's centre of mass from the hinge."""
    index = model.joint(joint).id
    body = model.jnt_bodyid[index]
    return float(np.linalg.norm(model.body_ipos[body] - model.jnt_pos[index]))


def accepted(system: System, psi: dict[str, float], effect: Effect) -> list[Accepted]:
    """The answers that count as right beside the concealed effect itself."""
    model, p = system.compile(psi), effect.parameters
    if system.name == "slider" and (effect.name == "constant_force" or effect.element == "qpos/rail"):
        return _sprung(model, effect)
    result: list[Accepted] = []
    root, root_body = system.joints[0], system.bodies[0]
    slides = model.jnt_type[model.joint(root).id] == mujoco.mjtJoint.mjJNT_SLIDE
    arm = 1.0 if slides else lever(model, root)
    motor = _motor(model, effect.element) if effect.kind == "joint" else None
    match effect.name:
        case "viscous_damping" if effect.element == root:
            c = p["coefficient"] / arm**2
            result.append(_entry("linear_drag", "body", root_body, coefficient=c))
        case "quadratic_damping" if effect.element == root:
            c = p["coefficient"] / arm**3
            result.append(_entry("quadratic_drag", "body", root_body, coefficient=c))
        case "quadratic_drag" if effect.element == root_body:
            c = p["coefficient"] * arm**3
            result.append(_entry("quadratic_damping", "joint", root, coefficient=c))
        case "constant_force" if motor is not None:
            name, gain = motor
            result.append(_entry("actuator_bias", "actuator", name, offset=p["force"] / gain))
        case "armature" if effect.element == root:
            added = {"mass": p["inertia"] / arm**2}
            result.append(_entry("added_mass", "body", root_body, **added))
            result.append(_entry("inertia_error", "body", root_body))
        case "armature" if system.name == "cart_pole":
            # the pole turns with its joint alone; payload_mass and com_offset come near, but are told apart
            result.append(_entry("inertia_error", "body", "pole"))
        case "sensor_bias" if effect.element == f"qpos/{root}" and not slides:
            # hanging from a y hinge: an angle that reads b too much is gravity leaning to -x by b
            result.append(_entry("gravity_tilt", "world", "world", toward_x=-p["offset"], toward_y=0.0))
            if system.name == "pendulum":  # mod psi: the centre of mass beside the line that is read
                result += [_entry(n, "body", root_body) for n in ("com_offset", "payload_mass")]
        case "actuator_delay" if len(system.actuators) == 1:
            result.append(_entry("sensor_delay", "sensor", "*", delay=p["delay"]))
    return result


def _motor(model: mujoco.MjModel, joint: str) -> tuple[str, float] | None:
    index = model.joint(joint).id
    for actuator in range(model.nu):
        if model.actuator_trnid[actuator, 0] == index:
            return model.actuator(actuator).name, float(model.actuator_gainprm[actuator, 0])
    return None


def _sprung(model: mujoco.MjModel, effect: Effect) -> list[Accepted]:
    """On one sprung horizontal slide a force, a tilt, a zero offset and a spring's rest are the same."""
    stiffness, weight = float(model.jnt_stiffness[0]), 9.81 * float(model.body("carriage").mass[0])
    p = effect.parameters
    force = p["force"] if effect.name == "constant_force" else stiffness * p["offset"]
    same = [
        _entry("constant_force", "joint", "rail", force=force),
        _entry("sensor_bias", "sensor", "qpos/rail", offset=force / stiffness),
        _entry("actuator_bias", "actuator", "coil", offset=force),
        _entry("gravity_tilt", "world", "world", toward_x=float(np.arcsin(force / weight)), toward_y=0.0),
        _entry("joint_spring", "joint", "rail"),
    ]
    return [entry for entry in same if entry["name"] != effect.name]
