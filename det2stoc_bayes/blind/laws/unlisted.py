"""Concealed forces that no catalogue has. q, v, t: position, speed, recorded time; u: the command of a joint's motor.

They are drawn only when asked for, and are right under the name `unlisted` with the variables they depend on.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, Scene, motors_of

Shape = Callable[[Parameters, float, float, float, float], float]  # of (parameters, q, v, t, u)


def _pushing(shape: Shape) -> Callable[[mujoco.MjModel, str, Parameters], Force]:
    """A generalized force by its shape; u is 0 where the joint has no motor of its own."""

    def push(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
        joint, motors = model.joint(element), motors_of(model, element)
        position, dof = joint.qposadr[0], joint.dofadr[0]

        def add(data: mujoco.MjData, t: float) -> None:
            u = data.ctrl[motors[0]] if motors else 0.0
            data.qfrc_applied[dof] += shape(p, data.qpos[position], data.qvel[dof], t, u)

        return add

    return push


def _detents(p: Parameters, q: float, v: float, t: float, u: float) -> float:
    """Towards the bottom of two wells (1 - erf-like potentials), nothing far from them."""
    ways = [(q - p["first"]) / p["width"], (q - p["second"]) / p["width"]]
    return -p["strength"] * sum(x * np.exp(0.5 - 0.5 * x * x) for x in ways)


def _ledges(p: Parameters, q: float, v: float, t: float, u: float) -> float:
    """A push forwards about one place and a weaker one backwards about another."""
    bump = [np.exp(-(((q - p[name]) / p["width"]) ** 2)) for name in ("first", "second")]
    return p["strength"] * (bump[0] - 0.6 * bump[1])


def _eddy_brake(p: Parameters, q: float, v: float, t: float, u: float) -> float:
    """A brake by eddy currents: strongest at one speed, weaker above it."""
    x = v / p["velocity"]
    return -2.0 * p["strength"] * x / (1.0 + x * x)


def _sticky_zone(p: Parameters, q: float, v: float, t: float, u: float) -> float:
    """Damping within a stretch of the way."""
    return -p["strength"] * v / p["velocity"] * np.exp(-(((q - p["first"]) / p["width"]) ** 2))


def _pulses(p: Parameters, q: float, v: float, t: float, u: float) -> float:
    """Two knocks at fixed times, the second one backwards."""
    shape = [np.exp(-(((t - p[name]) / p["width"]) ** 2)) for name in ("first", "second")]
    return p["strength"] * (shape[0] - 0.7 * shape[1])


def _chirp(p: Parameters, q: float, v: float, t: float, u: float) -> float:
    """A hum whose pitch rises."""
    return p["strength"] * np.sin(2.0 * np.pi * (p["frequency"] + 0.5 * p["rise"] * t) * t)


def _rectified(p: Parameters, q: float, v: float, t: float, u: float) -> float:
    """A pull that grows with the square of the command, whichever its sign."""
    return p["strength"] * (u / p["command"]) ** 2


def _two_places(scene: Scene, joint: str, rng: np.random.Generator, width: float) -> Parameters:
    travel = scene.joint[joint]["travel"]
    middle = rng.uniform(-0.4, 0.4) * travel
    apart = rng.uniform(0.6, 1.1) * travel
    return {"first": middle - apart, "second": middle + apart, "width": rng.uniform(width, 1.6 * width) * travel}


def _draw_wells(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    return _two_places(scene, joint, rng, 0.25)


def _draw_ledges(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    return _two_places(scene, joint, rng, 0.3)


def _draw_speed(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    return {"velocity": rng.uniform(0.4, 0.8) * scene.joint[joint]["speed"]}


def _draw_zone(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    travel, speed = scene.joint[joint]["travel"], scene.joint[joint]["speed"]
    return {"velocity": speed, "first": rng.uniform(-0.8, 0.8) * travel, "width": rng.uniform(0.4, 0.7) * travel}


def _draw_times(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    long = scene.duration
    return {
        "first": rng.uniform(0.15, 0.4) * long,
        "second": rng.uniform(0.55, 0.8) * long,
        "width": rng.uniform(0.05, 0.1) * long,
    }


def _draw_pitch(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    low = rng.uniform(0.8, 1.2) / scene.duration
    return {"frequency": low, "rise": rng.uniform(2.0, 3.5) / scene.duration**2}


def _draw_command(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    motor = scene.model.actuator(motors_of(scene.model, joint)[0]).name
    return {"command": scene.actuator[motor]["command"]}


def _one_motor(scene: Scene, joint: str) -> bool:
    return len(motors_of(scene.model, joint)) == 1


def _law(shape: Shape, variables: tuple[str, ...], draw, units: dict[str, str], **more) -> Law:
    return Law(
        "joint",
        {"strength": "N|N m", **units},
        lambda scene, joint: scene.joint[joint]["force"],
        lambda m, drawn: {"strength": m, **drawn},
        draw,
        signed=True,
        push=_pushing(shape),
        variables=variables,
        **more,
    )


_PLACES = {"first": "m|rad", "second": "m|rad", "width": "m|rad"}
UNLISTED_LAWS: dict[str, Law] = {
    "detents": _law(_detents, ("position",), _draw_wells, _PLACES),
    "ledges": _law(_ledges, ("position",), _draw_ledges, _PLACES),
    "eddy_brake": _law(_eddy_brake, ("velocity",), _draw_speed, {"velocity": "m/s|rad/s"}),
    "sticky_zone": _law(
        _sticky_zone,
        ("position", "velocity"),
        _draw_zone,
        {"velocity": "m/s|rad/s", "first": "m|rad", "width": "m|rad"},
    ),
    "pulses": _law(_pulses, ("time",), _draw_times, {"first": "s", "second": "s", "width": "s"}),
    "chirp": _law(_chirp, ("time",), _draw_pitch, {"frequency": "Hz", "rise": "Hz/s"}),
    "rectified_command": _law(_rectified, ("control",), _draw_command, {"command": "1"}, fits=_one_motor),
}
