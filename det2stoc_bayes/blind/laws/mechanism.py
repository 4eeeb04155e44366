"""Concealed laws of what is between a motor and its joint, or between joints: play, presliding, a coupling."""

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws.base import Force, Law, Parameters, Scene, actuator_force, motors_of


def _hold(model: mujoco.MjModel, joint: str) -> float:
    """Stiffness with which a joint's servos hold it, seen at the joint."""
    return float(sum(-model.actuator_biasprm[a, 1] * model.actuator_gear[a, 0] ** 2 for a in motors_of(model, joint)))


def _play(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """A servo's torque has a dead zone, as wide as what it would take to hold the gap open."""
    dof, motors = model.joint(element).dofadr[0], motors_of(model, element)
    width = 0.5 * p["gap"] * _hold(model, element)

    def loosen(data: mujoco.MjData, t: float) -> None:
        given = sum(model.actuator_gear[a, 0] * actuator_force(model, data, a, data.ctrl[a])[0] for a in motors)
        data.qfrc_applied[dof] -= min(max(given, -width), width)

    return loosen


class _Presliding:
    """A spring that is stretched with the joint and slips at its largest force.

    Within a step the stretch follows from where the step began; `settle` ends it.
    """

    def __init__(self, model: mujoco.MjModel, element: str, p: Parameters) -> None:
        joint = model.joint(element)
        self.position, self.dof = joint.qposadr[0], joint.dofadr[0]
        self.stiffness, self.most = p["stiffness"], p["force"]
        self.kept: tuple[float, float] | None = None  # position and force at the last settled step

    def force(self, data: mujoco.MjData) -> float:
        q = float(data.qpos[self.position])
        if self.kept is None:
            self.kept = q, 0.0
        before, given = self.kept
        return min(max(given - self.stiffness * (q - before), -self.most), self.most)

    def __call__(self, data: mujoco.MjData, t: float) -> None:
        data.qfrc_applied[self.dof] += self.force(data)

    def settle(self, data: mujoco.MjData) -> None:
        self.kept = float(data.qpos[self.position]), self.force(data)


def _together(model: mujoco.MjModel, element: str, p: Parameters) -> Force:
    """A spring and a damper between a joint and a multiple of another one."""
    driven, source = model.joint(element), model.joint(p["source"])
    row = np.zeros(model.nv)
    row[driven.dofadr[0]], row[source.dofadr[0]] = 1.0, -p["ratio"]

    def hold(data: mujoco.MjData, t: float) -> None:
        apart = data.qpos[driven.qposadr[0]] - p["ratio"] * data.qpos[source.qposadr[0]]
        data.qfrc_applied[:] -= row * (p["stiffness"] * apart + p["damping"] * float(row @ data.qvel))

    return hold


def _draw_partner(rng: np.random.Generator, scene: Scene, joint: str) -> Parameters:
    """Any other joint, and how fast differences fade."""
    others = [name for name in scene.joint if name != joint]
    ratio = rng.choice((-1.0, 1.0)) * np.exp(rng.uniform(np.log(0.4), np.log(2.0)))
    return {"source": others[rng.integers(len(others))], "ratio": ratio, "fading": rng.uniform(0.02, 0.2)}


def _coupling_value(m: float, drawn: Parameters) -> Parameters:
    named = {key: drawn[key] for key in ("ratio", "source")}
    return {"stiffness": m, **named, "damping": m * drawn["fading"]}


MECHANISM_LAWS: dict[str, Law] = {
    "backlash": Law(
        "joint",
        {"gap": "m|rad"},
        lambda scene, joint: 0.5 * scene.joint[joint]["travel"],
        lambda m, drawn: {"gap": m},
        fits=lambda scene, joint: _hold(scene.model, joint) > 0.0,
        push=_play,
    ),
    "hysteresis": Law(
        "joint",
        {"force": "N|N m", "stiffness": "N/m|N m/rad"},
        lambda scene, joint: scene.joint[joint]["force"],
        lambda m, drawn: {"force": m, "stiffness": m / drawn["way"]},
        draw=lambda rng, scene, joint: {"way": rng.uniform(0.05, 0.3) * scene.joint[joint]["travel"]},
        push=_Presliding,
    ),
    "coupling": Law(
        "joint",
        {"stiffness": "N/m|N m/rad", "ratio": "1", "source": "", "damping": "N s/m|N m s/rad"},
        lambda scene, joint: 10.0 * scene.joint[joint]["force"] / max(scene.joint[joint]["travel"], 1e-6),
        _coupling_value,
        draw=_draw_partner,
        fits=lambda scene, joint: len(scene.joint) > 1,
        push=_together,
    ),
}
