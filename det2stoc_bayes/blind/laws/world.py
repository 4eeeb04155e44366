"""Concealed laws of the world: gravity and wind."""

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, direction, in_medium
from det2stoc_bayes.blind.laws.joint import draw_oscillation


def _tilt(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    """Gravity keeps its size and leans towards + of the axes by these angles."""
    size = np.linalg.norm(model.opt.gravity)
    x, y = np.sin(p["toward_x"]), np.sin(p["toward_y"])
    with np.errstate(invalid="ignore"):  # a size beyond all tilts, which is tried, gives no motion
        model.opt.gravity[:] = size * np.array([x, y, -np.sqrt(1.0 - x * x - y * y)])


def _change(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.opt.gravity[2] += p["change"]


def _wind(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.opt.wind[:] += p["velocity"]


def _gusts(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    steady = model.opt.wind.copy()

    def blow(data: mujoco.MjData, t: float) -> None:
        model.opt.wind[:] = steady * (1.0 + p["amplitude"] * np.sin(2.0 * np.pi * p["frequency"] * t + p["phase"]))

    return blow


WORLD_LAWS: dict[str, Law] = {
    "gravity_tilt": Law(
        "world",
        {"toward_x": "rad", "toward_y": "rad"},
        lambda scene, element: 0.3,
        lambda m, drawn: {"toward_x": m * np.cos(drawn["heading"]), "toward_y": m * np.sin(drawn["heading"])},
        draw=lambda rng, scene, element: {"heading": rng.uniform(-np.pi, np.pi)},
        axes=("toward_x", "toward_y"),
        prepare=_tilt,
    ),
    "gravity_error": Law(
        "world",
        {"change": "m/s2"},
        lambda scene, element: 3.0,
        lambda m, drawn: {"change": m},
        signed=True,
        prepare=_change,
    ),
    "steady_wind": Law(
        "world",
        {"velocity": "m/s"},
        lambda scene, element: 8.0,
        lambda m, drawn: {"velocity": m * drawn["axis"]},
        draw=direction,
        fits=in_medium,
        prepare=_wind,
    ),
    "periodic_wind": Law(
        "world",
        {"amplitude": "1", "frequency": "Hz", "phase": "rad"},
        lambda scene, element: 1.0,
        lambda m, drawn: {"amplitude": m, **drawn},
        draw=draw_oscillation,
        fits=lambda scene, element: in_medium(scene, element) and bool(np.any(scene.model.opt.wind)),
        push=_gusts,
    ),
}
