"""Concealed motions of the frame in which everything is recorded."""

from collections.abc import Callable

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, Scene, cross, direction
from det2stoc_bayes.blind.laws.joint import draw_oscillation


def _on_everything(
    model: mujoco.MjModel, push: Callable[[mujoco.MjData, float, int, np.ndarray, np.ndarray], tuple]
) -> Force:
    """Force and torque on each body's centre of mass, from its place and Jacobians (along, about)."""
    along, about = np.zeros((3, model.nv)), np.zeros((3, model.nv))

    def add(data: mujoco.MjData, t: float) -> None:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for body in range(1, model.nbody):
            mujoco.mj_jacBodyCom(model, data, along, about, body)
            force, torque = push(data, t, body, along @ data.qvel, about @ data.qvel)
            data.qfrc_applied[:] += along.T @ force + about.T @ torque

    return add


def _shake(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """Every mass lags behind the base's acceleration."""
    pulse, amplitude = 2.0 * np.pi * p["frequency"], np.array(p["amplitude"])

    def push(data: mujoco.MjData, t: float, body: int, velocity: np.ndarray, spin: np.ndarray) -> tuple:
        acceleration = -(pulse**2) * amplitude * np.sin(pulse * t + p["phase"])
        return -model.body_mass[body] * acceleration, np.zeros(3)

    return _on_everything(model, push)


def _turn(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """Coriolis and centrifugal forces, and what they come to about the centre of mass of an extended body."""
    rate = np.array(p["rate"])

    def push(data: mujoco.MjData, t: float, body: int, velocity: np.ndarray, spin: np.ndarray) -> tuple:
        force = -2.0 * cross(rate, velocity) - cross(rate, cross(rate, data.xipos[body]))
        axes = data.ximat[body].reshape(3, 3)
        inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
        # Each point feels -2 rate x (spin x r) - rate x (rate x r); integrals of r r' follow from the inertia.
        second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        # integral of r x (a x (b x r)) = -(b x) S a, with S the second moments, summed over points
        torque = cross(2.0 * spin + rate, second @ rate)
        return model.body_mass[body] * force, torque

    return _on_everything(model, push)


def _draw_shake(rng: np.random.Generator, scene: Scene, element: str) -> Parameters:
    return direction(rng, scene, element) | draw_oscillation(rng, scene, element)


def _shake_value(m: float, drawn: Parameters) -> Parameters:
    """The size is the acceleration's."""
    amplitude = m / (2.0 * np.pi * drawn["frequency"]) ** 2 * drawn["axis"]
    return {"amplitude": amplitude, "frequency": drawn["frequency"], "phase": drawn["phase"]}


FRAME_LAWS: dict[str, Law] = {
    "base_vibration": Law(
        "world",
        {"amplitude": "m", "frequency": "Hz", "phase": "rad"},
        lambda scene, element: 5.0,
        _shake_value,
        draw=_draw_shake,
        push=_shake,
    ),
    "rotating_frame": Law(
        "world",
        {"rate": "rad/s"},
        lambda scene, element: 3.0,
        lambda m, drawn: {"rate": m * drawn["axis"]},
        draw=direction,
        push=_turn,
    ),
}
