"""Concealed laws of bodies: forces on the centre of mass, and mass that is elsewhere than believed."""

from collections.abc import Callable

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, Scene, cross, direction, in_medium, is_free


def _on_centre(formula: Callable[[float, np.ndarray, np.ndarray], np.ndarray]):
    """A force on the centre of mass by a formula of (coefficient, its velocity, the body's spin), world frame."""

    def push(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
        body, coefficient = model.body(element).id, p["coefficient"]
        along, about = np.zeros((3, model.nv)), np.zeros((3, model.nv))

        def add(data: mujoco.MjData, t: float) -> None:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacBodyCom(model, data, along, about, body)
            data.qfrc_applied[:] += along.T @ formula(coefficient, along @ data.qvel, about @ data.qvel)

        return add

    return push


def _tensor(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass and inertia about it, in the body's frame."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    turn = turn.reshape(3, 3)
    return model.body_ipos[body].copy(), turn @ np.diag(model.body_inertia[body]) @ turn.T


def _shifted(mass: float, offset: np.ndarray) -> np.ndarray:
    """A point mass's inertia about a point that it is `offset` away from."""
    return mass * ((offset @ offset) * np.eye(3) - np.outer(offset, offset))


def _payload(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    """A point mass fixed to the body: new mass, centre, and principal inertia."""
    body, extra, place = model.body(element).id, p["mass"], np.asarray(p["offset"])
    own, (centre, inertia) = float(model.body_mass[body]), _tensor(model, body)
    new_centre = (own * centre + extra * place) / (own + extra)
    inertia = inertia + _shifted(own, centre - new_centre) + _shifted(extra, place - new_centre)
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = own + extra, new_centre, moments
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())


def _symmetric(model: mujoco.MjModel, element: str) -> bool:
    """Whether moments are equal: their axes, on which MuJoCo's drag depends, would jump with the payload."""
    small, middle, large = np.sort(model.body(element).inertia)
    return bool(min(middle - small, large - middle) < 0.01 * large)


def _mass(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    body = model.body(element).id
    model.body_inertia[body] *= 1.0 + p["mass"] / model.body_mass[body]
    model.body_mass[body] += p["mass"]


def _centre(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.body_ipos[model.body(element).id] += p["offset"]


def _inertia(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.body_inertia[model.body(element).id] *= p["ratio"]


def _drag_range(power: int) -> Callable[[Scene, str], float]:
    return lambda scene, body: scene.body[body]["force"] / max(scene.body[body]["speed"], 1e-6) ** power


def _draw_place(rng: np.random.Generator, scene: Scene, body: str) -> Parameters:
    """Somewhere on the body's surface or inside."""
    return {"offset": scene.model.body(body).ipos + scene.body[body]["extent"] * rng.uniform(-1.0, 1.0, 3)}


BODY_LAWS: dict[str, Law] = {
    "linear_drag": Law(
        "body",
        {"coefficient": "N s/m"},
        _drag_range(1),
        lambda m, drawn: {"coefficient": m},
        push=_on_centre(lambda c, v, spin: -c * v),
    ),
    "quadratic_drag": Law(
        "body",
        {"coefficient": "kg/m"},
        _drag_range(2),
        lambda m, drawn: {"coefficient": m},
        push=_on_centre(lambda c, v, spin: -c * np.linalg.norm(v) * v),
    ),
    "magnus_lift": Law(
        "body",
        {"coefficient": "kg"},
        lambda scene, body: scene.body[body]["force"] / (scene.body[body]["speed"] * scene.body[body]["spin"]),
        lambda m, drawn: {"coefficient": m},
        fits=lambda scene, body: is_free(scene.model, body),
        push=_on_centre(lambda c, v, spin: c * cross(spin, v)),
    ),
    "payload_mass": Law(
        "body",
        {"mass": "kg", "offset": "m"},
        lambda scene, body: scene.body[body]["mass"],
        lambda m, drawn: {"mass": m, **drawn},
        draw=_draw_place,
        definite=lambda scene, body: not (in_medium(scene, body) and _symmetric(scene.model, body)),
        prepare=_payload,
    ),
    "mass_error": Law(
        "body",
        {"mass": "kg"},
        lambda scene, body: 0.6 * scene.body[body]["mass"],
        lambda m, drawn: {"mass": m},
        signed=True,
        prepare=_mass,
    ),
    "com_offset": Law(
        "body",
        {"offset": "m"},
        lambda scene, body: scene.body[body]["extent"],
        lambda m, drawn: {"offset": m * drawn["axis"]},
        draw=direction,
        prepare=_centre,
    ),
    "inertia_error": Law(
        "body",
        {"ratio": "1"},
        lambda scene, body: 0.8,
        lambda m, drawn: {"ratio": [1.0 + m] * 3},  # all alike: possible for every body
        signed=True,
        prepare=_inertia,
    ),
}
