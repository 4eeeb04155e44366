"""Concealed laws between a command u and what the actuator receives, or can deliver.

How late a command arrives (actuator_delay, actuator_lag) is resolved by the simulation itself, in laws/signals.py.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Law, Mapping, Parameters, Scene, actuator_force


def _map(formula: Callable[[Parameters, float, float], float]) -> Callable[..., Mapping]:
    """What arrives by a formula of (parameters, u, t)."""

    def receive(model: mujoco.MjModel, actuator: int, p: Parameters) -> Mapping:
        def rewrite(data: mujoco.MjData, t: float, u: np.ndarray) -> None:
            u[actuator] = formula(p, u[actuator], t)

        return rewrite

    return receive


def _limited(model: mujoco.MjModel, actuator: int, p: Parameters) -> Mapping:
    """The force falls linearly to zero at the no-load speed, and never exceeds what it is at a stall."""
    joint, gear = model.actuator_trnid[actuator, 0], model.actuator_gear[actuator, 0]
    dof, gain = model.jnt_dofadr[joint], model.actuator_gainprm[actuator, 0]

    def rewrite(data: mujoco.MjData, t: float, u: np.ndarray) -> None:
        force, own = actuator_force(model, data, actuator, u[actuator])
        share = data.qvel[dof] / p["no_load_speed"]
        most = p["stall"] * np.clip(1.0 - share, 0.0, 1.0) / gear
        least = -p["stall"] * np.clip(1.0 + share, 0.0, 1.0) / gear
        u[actuator] = (np.clip(force, least, most) - own) / gain

    return rewrite


def _joint_of(scene: Scene, actuator: str) -> str:
    return scene.model.joint(scene.model.actuator_trnid[scene.model.actuator(actuator).id, 0]).name


def _draw_motor(rng: np.random.Generator, scene: Scene, actuator: str) -> Parameters:
    speed = scene.joint[_joint_of(scene, actuator)]["speed"]
    return {"no_load_speed": rng.uniform(2.0, 5.0) * speed, "most": 2.0 * scene.actuator[actuator]["force"]}


def _law(units: dict[str, str], largest: Callable[[Scene, str], float], value, **more) -> Law:
    return Law("actuator", units, largest, value, **more)


def _command(share: float) -> Callable[[Scene, str], float]:
    """A share of the largest command."""
    return lambda scene, actuator: share * scene.actuator[actuator]["command"]


ACTUATOR_LAWS: dict[str, Law] = {
    "actuator_delay": _law({"delay": "s"}, lambda scene, actuator: 0.08, lambda m, drawn: {"delay": m}),
    "actuator_lag": _law({"time_constant": "s"}, lambda scene, actuator: 0.15, lambda m, drawn: {"time_constant": m}),
    "actuator_gain": _law(
        {"ratio": "1"},
        lambda scene, actuator: 0.6,
        lambda m, drawn: {"ratio": 1.0 + m},
        signed=True,
        receive=_map(lambda p, u, t: p["ratio"] * u),
    ),
    "actuator_bias": _law(
        {"offset": "unit of u"},
        _command(0.5),
        lambda m, drawn: {"offset": m},
        signed=True,
        receive=_map(lambda p, u, t: u + p["offset"]),
    ),
    "actuator_dead_zone": _law(
        {"width": "unit of u"},
        _command(0.7),
        lambda m, drawn: {"width": m},
        receive=_map(lambda p, u, t: float(np.sign(u) * max(abs(u) - p["width"], 0.0))),
    ),
    "actuator_saturation": _law(
        {"limit": "unit of u"},
        lambda scene, actuator: 0.85,
        lambda m, drawn: {"limit": (1.0 - m) * drawn["most"]},
        draw=lambda rng, scene, actuator: {"most": scene.actuator[actuator]["command"]},
        receive=_map(lambda p, u, t: float(np.clip(u, -p["limit"], p["limit"]))),
    ),
    "actuator_gain_drift": _law(
        {"rate": "1/s"},
        lambda scene, actuator: 1.0 / scene.duration,
        lambda m, drawn: {"rate": m},
        receive=_map(lambda p, u, t: float(u * np.exp(-p["rate"] * t))),
    ),
    "torque_speed_limit": _law(
        {"stall": "N|N m", "no_load_speed": "m/s|rad/s"},
        lambda scene, actuator: 0.9,
        lambda m, drawn: {"stall": (1.0 - m) * drawn["most"], "no_load_speed": drawn["no_load_speed"]},
        draw=_draw_motor,
        receive=_limited,
    ),
}
