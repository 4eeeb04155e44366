"""Concealed pulls towards a point in space: a string that is slack at times, and an attraction."""

from collections.abc import Callable

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, Scene


def _towards(point: str, size: Callable[[Parameters, float], float]):
    """A pull on the centre of mass towards a point, by its distance from there."""

    def push(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
        body, along, target = model.body(element).id, np.zeros((3, model.nv)), np.array(p[point])

        def add(data: mujoco.MjData, t: float) -> None:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacBodyCom(model, data, along, None, body)
            way = target - data.xipos[body]
            distance = float(np.linalg.norm(way))
            if distance > 0.0:
                data.qfrc_applied[:] += along.T @ (size(p, distance) / distance * way)

        return add

    return push


def _room(scene: Scene, body: str) -> float:
    """A length on which the body moves, roughly."""
    return max(2.0 * scene.body[body]["extent"], 0.3 * scene.body[body]["speed"])


def _draw_point(rng: np.random.Generator, scene: Scene, body: str) -> tuple[np.ndarray, float]:
    """A point about the body's place at rest, and its distance from there."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    axis = rng.standard_normal(3)
    distance = rng.uniform(0.8, 1.6) * _room(scene, body)
    return data.xipos[scene.model.body(body).id] + distance * axis / np.linalg.norm(axis), distance


def _draw_anchor(rng: np.random.Generator, scene: Scene, body: str) -> Parameters:
    anchor, distance = _draw_point(rng, scene, body)
    return {"length": rng.uniform(0.5, 1.0) * distance, "anchor": anchor}


STRING_LAWS: dict[str, Law] = {
    "tether": Law(
        "body",
        {"stiffness": "N/m", "length": "m", "anchor": "m"},
        lambda scene, body: 5.0 * scene.body[body]["force"] / _room(scene, body),
        lambda m, drawn: {"stiffness": m, **drawn},
        draw=_draw_anchor,
        push=_towards("anchor", lambda p, r: p["stiffness"] * max(r - p["length"], 0.0)),
    ),
    "attraction": Law(
        "body",
        {"strength": "N m2", "centre": "m"},
        lambda scene, body: 3.0 * scene.body[body]["force"] * _room(scene, body) ** 2,
        lambda m, drawn: {"strength": m, **drawn},
        draw=lambda rng, scene, body: {"centre": _draw_point(rng, scene, body)[0]},
        push=_towards("centre", lambda p, r: p["strength"] / r**2),
    ),
}
