"""A concealed stop: MuJoCo's own joint limit on one side."""

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Law, Parameters, Scene

OUTSIDE = 2.5  # rms travels from zero that no recording reaches
ENDLESS = 1e6


def _stop(model: mujoco.MjModel, element: str, p: Parameters) -> None:
    """Positions beyond the stop, seen from zero, are barred."""
    joint, place = model.joint(element).id, p["position"]
    own = model.jnt_range[joint] if model.jnt_limited[joint] else np.array([-ENDLESS, ENDLESS])
    model.jnt_range[joint] = [own[0], min(own[1], place)] if place > 0.0 else [max(own[0], place), own[1]]
    model.jnt_limited[joint] = True


def _draw_side(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    return {"outside": rng.choice((-1.0, 1.0)) * OUTSIDE * scene.joint[joint]["travel"]}


STOP_LAWS: dict[str, Law] = {
    "hard_stop": Law(
        "joint",
        {"position": "m|rad"},
        lambda scene, joint: 0.9,
        lambda m, drawn: {"position": drawn["outside"] * (1.0 - m)},
        draw=_draw_side,
        prepare=_stop,
    )
}
