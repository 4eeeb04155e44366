"""Concealed laws of joints. q, v: position and speed; every force adds to what the model has."""

from collections.abc import Callable

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, Scene, actuator_force, motors_of, nothing

Formula = Callable[[Parameters, float, float, float], float]  # of (parameters, q, v, t)


def _force(formula: Formula) -> Callable[[mujoco.MjModel, str, Parameters], Force]:
    """A generalized force by a formula."""

    def push(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
        joint = model.joint(element)
        position, dof = joint.qposadr[0], joint.dofadr[0]

        def add(data: mujoco.MjData, t: float) -> None:
            data.qfrc_applied[dof] += formula(p, data.qpos[position], data.qvel[dof], t)

        return add

    return push


def _friction(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.dof_frictionloss[model.joint(element).dofadr[0]] += p["force"]


def _reflected(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.dof_armature[model.joint(element).dofadr[0]] += p["inertia"]


def _stribeck(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """Dry friction, which holds at rest, with a limit that falls with speed."""
    dof = model.joint(element).dofadr[0]
    own = float(model.dof_frictionloss[dof])

    def limit(data: mujoco.MjData, t: float) -> None:
        bump = (p["static"] - p["coulomb"]) * np.exp(-((data.qvel[dof] / p["velocity"]) ** 2))
        model.dof_frictionloss[dof] = own + p["coulomb"] + bump

    return limit


def _load_dependent(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """Dry friction with a limit in proportion to what the joint's motors deliver."""
    dof, motors = model.joint(element).dofadr[0], motors_of(model, element)
    own = float(model.dof_frictionloss[dof])

    def limit(data: mujoco.MjData, t: float) -> None:
        load = sum(model.actuator_gear[a, 0] * actuator_force(model, data, a, data.ctrl[a])[0] for a in motors)
        model.dof_frictionloss[dof] = own + p["coefficient"] * abs(load)

    return limit


def _per(power_of_speed: int) -> Callable[[Scene, str], float]:
    """A coefficient whose force at typical speed is the typical force."""
    return lambda scene, joint: scene.joint[joint]["force"] / max(scene.joint[joint]["speed"], 1e-6) ** power_of_speed


def _stiffness(power: int) -> Callable[[Scene, str], float]:
    return lambda scene, joint: scene.joint[joint]["force"] / max(scene.joint[joint]["travel"], 1e-6) ** power


def _typical_force(scene: Scene, joint: str) -> float:
    return scene.joint[joint]["force"]


def _simple(key: str) -> Callable[[float, Parameters], Parameters]:
    return lambda m, drawn: {key: m, **drawn}


def _draw_rest(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    """Half of the springs rest elsewhere than at zero."""
    return {"rest": rng.uniform(-0.7, 0.7) * scene.joint[joint]["travel"]} if rng.uniform() < 0.5 else {}


def _draw_stribeck(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    return {"excess": rng.uniform(0.4, 1.5), "velocity": rng.uniform(0.1, 0.5) * scene.joint[joint]["speed"]}


def _draw_cogging(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    """Two to eight periods over twice the rms travel to both sides; on a hinge a whole number a turn."""
    cycles = np.pi * rng.uniform(2.0, 8.0) / (2.0 * scene.joint[joint]["travel"])
    hinge = scene.model.jnt_type[scene.model.joint(joint).id] == mujoco.mjtJoint.mjJNT_HINGE
    return {"cycles": max(round(cycles), 2) if hinge else cycles, "phase": rng.uniform(-np.pi, np.pi)}


def draw_oscillation(rng: np.random.Generator, scene: Scene, element: str) -> Parameters:
    """A frequency that a recording holds more than one period of, and that the sampling resolves."""
    high = min(5.0, 0.1 / scene.sampling)
    low = min(1.5 / scene.duration, 0.5 * high)
    return {"frequency": np.exp(rng.uniform(np.log(low), np.log(high))), "phase": rng.uniform(-np.pi, np.pi)}


def _law(units: dict[str, str], largest: Callable[[Scene, str], float], **more) -> Law:
    """A joint law whose first unit names the size parameter, unless `value` is given."""
    more.setdefault("value", _simple(next(iter(units))))
    more.setdefault("draw", nothing)
    return Law("joint", units, largest, **more)


def _stribeck_value(m: float, drawn: Parameters) -> Parameters:
    return {"coulomb": m, "static": m * (1.0 + drawn["excess"]), "velocity": drawn["velocity"]}


JOINT_LAWS: dict[str, Law] = {
    "viscous_damping": _law(
        {"coefficient": "N s/m|N m s/rad"}, _per(1), push=_force(lambda p, q, v, t: -p["coefficient"] * v)
    ),
    "coulomb_friction": _law({"force": "N|N m"}, _typical_force, prepare=_friction),
    "stribeck_friction": _law(
        {"coulomb": "N|N m", "static": "N|N m", "velocity": "m/s|rad/s"},
        _typical_force,
        value=_stribeck_value,
        draw=_draw_stribeck,
        push=_stribeck,
    ),
    "quadratic_damping": _law(
        {"coefficient": "N s2/m2|N m s2/rad2"}, _per(2), push=_force(lambda p, q, v, t: -p["coefficient"] * abs(v) * v)
    ),
    "load_dependent_friction": _law(
        {"coefficient": "1"},
        lambda scene, joint: 0.6,
        push=_load_dependent,
        fits=lambda scene, joint: bool(motors_of(scene.model, joint)),
    ),
    "joint_spring": _law(
        {"stiffness": "N/m|N m/rad", "rest": "m|rad"},
        _stiffness(1),
        draw=_draw_rest,
        push=_force(lambda p, q, v, t: -p["stiffness"] * (q - p.get("rest", 0.0))),
    ),
    "cubic_stiffness": _law(
        {"stiffness": "N/m3|N m/rad3"}, _stiffness(3), push=_force(lambda p, q, v, t: -p["stiffness"] * q * q * q)
    ),
    "constant_force": _law({"force": "N|N m"}, _typical_force, signed=True, push=_force(lambda p, q, v, t: p["force"])),
    "armature": _law(
        {"inertia": "kg|kg m2"}, lambda scene, joint: 3.0 * scene.joint[joint]["inertia"], prepare=_reflected
    ),
    "cogging_torque": _law(
        {"amplitude": "N|N m", "cycles": "1/m|1/rad", "phase": "rad"},
        _typical_force,
        draw=_draw_cogging,
        push=_force(lambda p, q, v, t: p["amplitude"] * np.sin(p["cycles"] * q + p["phase"])),
    ),
    "periodic_force": _law(
        {"amplitude": "N|N m", "frequency": "Hz", "phase": "rad"},
        _typical_force,
        draw=draw_oscillation,
        push=_force(lambda p, q, v, t: p["amplitude"] * np.sin(2.0 * np.pi * p["frequency"] * t + p["phase"])),
    ),
}
