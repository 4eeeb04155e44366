"""Concealed laws of contact, written on the geom of a pair that rests more: it outranks the other one."""

from collections.abc import Callable

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, Scene


def geoms_of(model: mujoco.MjModel, element: str) -> tuple[int, int]:
    """(the geom that moves, the geom that does not) of a pair named with a slash."""
    first, second = (model.geom(name).id for name in element.split("/"))
    fixed = [g for g in (first, second) if model.body_weldid[model.geom_bodyid[g]] == 0]
    still = fixed[0] if fixed else second
    return (second if still == first else first), still


def _outrank(model: mujoco.MjModel, element: str) -> int:
    """Gives the resting geom what the two have together, and the last word; its number."""
    mover, still = geoms_of(model, element)
    model.geom_friction[still] = np.maximum(model.geom_friction[still], model.geom_friction[mover])
    model.geom_solref[still] = 0.5 * (model.geom_solref[still] + model.geom_solref[mover])
    model.geom_condim[still] = max(model.geom_condim[still], model.geom_condim[mover])
    model.geom_priority[still] = 7
    return still


def _slippery(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.geom_friction[_outrank(model, element), 0] *= p["ratio"]


def _rolling(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    still = _outrank(model, element)
    model.geom_friction[still, 2] += p["coefficient"]
    model.geom_condim[still] = 6


def _turning(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    still = _outrank(model, element)
    model.geom_friction[still, 1] += p["coefficient"]
    model.geom_condim[still] = max(model.geom_condim[still], 4)


def _soft(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.geom_solref[_outrank(model, element), 0] = p["time_constant"]


def _bouncy(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.geom_solref[_outrank(model, element), 1] = p["damping_ratio"]


def _sticky(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.geom_adhesion[_outrank(model, element)] += p["force"]
    model.flg_adhesion = True


def _viscous(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """A force against the speed of the moving body's centre while any point of the two touches."""
    mover, still = geoms_of(model, element)
    body = int(model.geom_bodyid[mover])
    speed = np.zeros(6)

    def rub(data: mujoco.MjData, t: float) -> None:
        pairs = {frozenset((int(c.geom1), int(c.geom2))) for c in data.contact[: data.ncon] if c.dist <= 0.0}
        if frozenset((mover, still)) not in pairs:
            return
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, speed, 0)
        force, turn = -p["coefficient"] * speed[3:], np.zeros(3)
        mujoco.mj_applyFT(model, data, force, turn, data.xipos[body], body, data.qfrc_applied)

    return rub


def _rubbing(model: mujoco.MjModel, element: str, ratio: Callable[[mujoco.MjData, int], float]) -> Force:
    """A friction of the moment, `ratio` times the usual one, by the state of the moving body's joint."""
    mover, _ = geoms_of(model, element)
    still = _outrank(model, element)
    usual, joint = float(model.geom_friction[still, 0]), int(model.body_jntadr[model.geom_bodyid[mover]])

    def rub(data: mujoco.MjData, t: float) -> None:
        model.geom_friction[still, 0] = usual * ratio(data, joint)

    return rub


def _patch(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """Another friction while the moving body's frame is beyond a plane."""
    point, normal = np.asarray(p["point"]), np.asarray(p["normal"])

    def ratio(data: mujoco.MjData, joint: int) -> float:
        at = int(model.jnt_qposadr[joint])
        return p["ratio"] if (data.qpos[at : at + 3] - point) @ normal > 0.0 else 1.0

    return _rubbing(model, element, ratio)


def _grained(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """A friction that turns with the way of the moving body: `ratio` times as much along the grain as across it."""

    def ratio(data: mujoco.MjData, joint: int) -> float:
        at = int(model.jnt_dofadr[joint])
        angle = np.arctan2(data.qvel[at + 1], data.qvel[at]) - p["direction"]
        return float(np.hypot(p["ratio"] * np.cos(angle), np.sin(angle)))

    return _rubbing(model, element, ratio)


def _draw_region(rng: np.random.Generator, scene: Scene, element: str) -> Parameters:
    """A vertical plane across the middle of where the body goes."""
    turn = rng.uniform(-np.pi, np.pi)
    places = np.array(scene.contact[element]["places"])
    normal = np.array([np.cos(turn), np.sin(turn), 0.0])
    middle = np.median(places, axis=0)
    return {"point": middle, "normal": normal}


def _often(scene: Scene, element: str) -> bool:
    """Whether the two touch for a good part of the time."""
    return scene.contact[element]["share"] > 0.15


def _mostly(scene: Scene, element: str) -> bool:
    """Whether a body slides on something fixed nearly all the time."""
    _, still = geoms_of(scene.model, element)
    return bool(scene.contact[element]["share"] > 0.8 and scene.model.body_weldid[scene.model.geom_bodyid[still]] == 0)


def _number(scene: Scene, element: str, place: int) -> float:
    mover, still = geoms_of(scene.model, element)
    return float(0.5 * (scene.model.geom_solref[mover, place] + scene.model.geom_solref[still, place]))


def _size(scene: Scene, element: str) -> float:
    mover, _ = geoms_of(scene.model, element)
    return float(np.max(scene.model.geom_aabb[mover, 3:]))


def _weight(scene: Scene, element: str) -> float:
    mover, _ = geoms_of(scene.model, element)
    return float(scene.model.body_mass[scene.model.geom_bodyid[mover]] * np.linalg.norm(scene.model.opt.gravity))


def _ratio(m: float, drawn: Parameters) -> Parameters:
    return {"ratio": float(np.exp(m)), **drawn}


def _solref(name: str):
    return lambda m, drawn: {name: drawn["usual"] * float(np.exp(m))}


def _draw_number(place: int):
    return lambda rng, scene, element: {"usual": _number(scene, element, place)}


CONTACT_LAWS: dict[str, Law] = {
    "friction_error": Law(
        "contact", {"ratio": "1"}, lambda s, e: 0.6, _ratio, signed=True, fits=_often, prepare=_slippery
    ),
    "friction_patch": Law(
        "contact",
        {"ratio": "1", "point": "m", "normal": "1"},
        lambda s, e: 0.7,
        _ratio,
        draw=_draw_region,
        signed=True,
        fits=_often,
        push=_patch,
    ),
    "anisotropic_friction": Law(
        "contact",
        {"ratio": "1", "direction": "rad"},
        lambda s, e: 0.7,
        _ratio,
        draw=lambda rng, s, e: {"direction": float(rng.uniform(-0.5 * np.pi, 0.5 * np.pi))},
        signed=True,
        fits=_often,
        push=_grained,
    ),
    "rolling_friction": Law(
        "contact",
        {"coefficient": "m"},
        lambda s, e: 0.3 * _size(s, e),
        lambda m, drawn: {"coefficient": m},
        fits=_often,
        prepare=_rolling,
    ),
    "torsional_friction": Law(
        "contact",
        {"coefficient": "m"},
        lambda s, e: 0.5 * _size(s, e),
        lambda m, drawn: {"coefficient": m},
        fits=_often,
        prepare=_turning,
    ),
    "adhesion": Law(
        "contact",
        {"force": "N"},
        lambda s, e: 0.5 * _weight(s, e),
        lambda m, drawn: {"force": m},
        fits=_often,
        prepare=_sticky,
    ),
    "viscous_contact_friction": Law(
        "contact",
        {"coefficient": "N s/m"},
        lambda s, e: 0.5 * _weight(s, e),
        lambda m, drawn: {"coefficient": m},
        fits=_mostly,
        push=_viscous,
    ),
    "contact_stiffness": Law(
        "contact",
        {"time_constant": "s"},
        lambda s, e: 0.7,
        _solref("time_constant"),
        draw=_draw_number(0),
        signed=True,
        fits=_often,
        prepare=_soft,
    ),
    "restitution_error": Law(
        "contact",
        {"damping_ratio": "1"},
        lambda s, e: 0.9,
        _solref("damping_ratio"),
        draw=_draw_number(1),
        signed=True,
        fits=_often,
        prepare=_bouncy,
    ),
}
