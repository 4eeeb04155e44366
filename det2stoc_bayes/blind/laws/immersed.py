"""Concealed laws of bodies in a fluid that surrounds them: buoyancy, and fluid that is taken along."""

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, in_medium

AIR_DENSITY = 1.2  # kg/m3, where the model has no fluid


def lifted(model: mujoco.MjModel, element: str, mass: float) -> Force:
    """What carries the weight of so much mass, at the centre of mass."""
    body, along = model.body(element).id, np.zeros((3, model.nv))

    def add(data: mujoco.MjData, t: float) -> None:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBodyCom(model, data, along, None, body)
        data.qfrc_applied[:] -= along.T @ (mass * model.opt.gravity)

    return add


def _float(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    return lifted(model, element, (model.opt.density or AIR_DENSITY) * p["volume"])


def _heavier(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    model.body_mass[model.body(element).id] += p["mass"]


IMMERSED_LAWS: dict[str, Law] = {
    "buoyancy": Law(
        "body",
        {"volume": "m3"},
        lambda scene, body: scene.body[body]["mass"] / (scene.model.opt.density or AIR_DENSITY),
        lambda m, drawn: {"volume": m},
        push=_float,
    ),
    "added_mass": Law(
        "body",
        {"mass": "kg"},
        lambda scene, body: 2.0 * scene.body[body]["mass"],
        lambda m, drawn: {"mass": m},
        # MuJoCo's drag depends on mass and inertia: in a fluid more mass would be another shape.
        definite=lambda scene, body: not in_medium(scene, body),
        prepare=_heavier,
        push=lambda model, element, p: lifted(model, element, p["mass"]),
    ),
}
