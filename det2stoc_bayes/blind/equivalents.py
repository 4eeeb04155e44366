"""Which other answers name the same physics: no recording of the study can tell them apart.

Candidates come from lists of laws that can imitate one another; whether they do, with psi and the initial states
refitted, is judged by the concealing side's own refit. A few are exact by theory and have no law here.
"""

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws import LAWS, UNLISTED, Effect, Scene
from det2stoc_bayes.blind.laws.base import motors_of
from det2stoc_bayes.blind.probe import Probe
from det2stoc_bayes.blind.refit import linear_share, refit

Accepted = dict[str, Any]
NATS = 1.0  # of log likelihood over the whole study: what less than this tells apart is the same
OWN = 1.0  # noise sds of an unlisted effect that no listed law may take up
WORTH_A_REFIT = 0.8  # share of the RMS that may remain to first order
STEP = ("frequency", "phase")
IMITATORS = (
    # steady pushes and where things hang
    "constant_force actuator_bias sensor_bias gravity_tilt joint_spring com_offset payload_mass",
    # weight, inertia, and the strength of motors
    "armature inertia_error mass_error payload_mass com_offset actuator_gain gravity_error joint_spring",
    "added_mass armature mass_error payload_mass inertia_error",
    "buoyancy gravity_error mass_error com_offset constant_force",
    # along one slide a frame's turn is a push and a spring
    "rotating_frame constant_force actuator_bias sensor_bias gravity_tilt joint_spring",
    # losses in proportion to speed, and its square
    "viscous_damping linear_drag torque_speed_limit actuator_lag",
    "viscous_contact_friction linear_drag",
    "anisotropic_friction friction_error",
    "quadratic_damping quadratic_drag linear_drag steady_wind",
    "coulomb_friction stribeck_friction load_dependent_friction hysteresis backlash",
    "coupling joint_spring viscous_damping",
    "hard_stop joint_spring cubic_stiffness",
    "backlash actuator_dead_zone actuator_gain",
    # when things happen
    "actuator_delay actuator_lag sensor_delay clock_skew",
    # what a motor can deliver
    "actuator_saturation torque_speed_limit",
    "actuator_gain actuator_gain_drift sensor_scale",
    # over time, and flight
    "periodic_force periodic_wind base_vibration",
    "tether attraction joint_spring constant_force",
    "magnus_lift steady_wind linear_drag quadratic_drag gravity_tilt gravity_error",
)


def entry(effect: Effect) -> Accepted:
    """An effect as diagnosis.json writes one."""
    element = {"kind": effect.kind, "name": effect.element}
    variables = list(LAWS[effect.name].variables)
    name = {"name": UNLISTED, "law": effect.name, "variables": variables} if variables else {"name": effect.name}
    return {**name, "element": element, "parameters": effect.parameters}


def accepted(rng: np.random.Generator, probe: Probe, effect: Effect, samples: int) -> list[Accepted]:
    """The answers that count as right beside the concealed effect, in a study of so many samples of all columns.

    Of a larger family, which contains the effect, none is: it needs more parameters to say the same.
    """
    same_below = float(np.sqrt(2.0 * NATS / samples))
    rivals = [_timed_as(effect, _small(rng, probe.scene, *place)) for place in imitators(probe.scene, effect)]
    rivals = [rival for rival in rivals if _num_parameters(rival) <= _num_parameters(effect)]
    first = probe.first()
    shares = linear_share(first, first.with_effects(effect), rivals)
    truths = probe.with_effects(effect)
    result = _by_theory(probe.system.compile(probe.psi), effect)
    for rival, share in zip(rivals, shares, strict=True):
        if share < WORTH_A_REFIT:
            fitted = refit(probe, truths, [rival], enough=0.5 * same_below)
            if fitted.left < same_below:
                result.append(entry(fitted.rivals[0]))
    return result


def on_a_list(rng: np.random.Generator, probe: Probe, effect: Effect, size: float) -> bool:
    """Whether a listed law of its joint or motors leaves, to first order, too little of an effect of this size."""
    near = _near(probe.scene, effect) or set()
    rivals = [
        _small(rng, probe.scene, name, element)
        for name, law in LAWS.items()
        if law.kind in ("joint", "actuator") and not law.variables
        for element in sorted(near.intersection(probe.scene.names(law.kind)))
        if law.fits(probe.scene, element)
    ]
    first = probe.first()
    return size * min(linear_share(first, first.with_effects(effect), rivals), default=1.0) < OWN


def _small(rng: np.random.Generator, scene: Scene, name: str, element: str) -> Effect:
    """A small effect to start a fit from."""
    law = LAWS[name]
    drawn = law.draw(rng, scene, element)
    return Effect(name, law.kind, element, law.parameters(0.03 * law.largest(scene, element), drawn))


def _timed_as(effect: Effect, rival: Effect) -> Effect:
    """The rival in step with an effect: from another frequency no fit leads to its own."""
    same = {key: effect.parameters[key] for key in STEP if key in effect.parameters and key in rival.parameters}
    return replace(rival, parameters={**rival.parameters, **same})


def _num_parameters(effect: Effect) -> int:
    """A vector counts once, for its directions are not always seen."""
    axes = LAWS[effect.name].axes
    return len([key for key in effect.parameters if key not in axes]) + bool(axes)


def imitators(scene: Scene, effect: Effect) -> list[tuple[str, str]]:
    """(name, element) of laws that may imitate an effect: of one list, on elements next to one another."""
    groups = [group.split() for group in IMITATORS if effect.name in group.split()]
    names = list(dict.fromkeys(name for group in groups for name in group))
    near = _near(scene, effect)
    return [
        (name, element)
        for name in names
        for element in scene.names(LAWS[name].kind)
        if LAWS[name].fits(scene, element)
        and (near is None or element in near or LAWS[name].kind == "world")
        and (name, element) != (effect.name, effect.element)
    ]


def _near(scene: Scene, effect: Effect) -> set[str] | None:
    """Names of a joint, its body and contacts, its motors and columns, given any of them; None: everything is near."""
    if effect.kind == "world":
        return None
    result: set[str] = {"time"}
    for joint in scene.joint:
        index = scene.model.joint(joint).id
        motors = [scene.model.actuator(a).name for a in motors_of(scene.model, joint)]
        body = scene.model.body(scene.model.jnt_bodyid[index]).name
        touching = {c for c in scene.contact if body in _bodies(scene.model, c)}
        unit = {joint, body, *motors, f"qpos/{joint}", f"qvel/{joint}", *touching}
        if effect.element in unit:
            result |= unit
    return result | {effect.element}


def _bodies(model: mujoco.MjModel, contact: str) -> set[str]:
    """Names of the bodies whose geoms are a contact's."""
    return {model.body(model.geom_bodyid[model.geom(name).id]).name for name in contact.split("/")}


def _by_theory(model: mujoco.MjModel, effect: Effect) -> list[Accepted]:
    """Exact equivalents that have no law here."""
    p = effect.parameters
    if effect.name == "actuator_delay" and model.nu == 1:  # and so every sensor is late by as much
        return [{"name": "sensor_delay", "element": {"kind": "sensor", "name": "*"}, "parameters": dict(p)}]
    if effect.name != "armature":
        return []
    joint = model.joint(effect.element).id
    body = model.jnt_bodyid[joint]
    if model.body_parentid[body] != 0:
        return []
    slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    arm = 1.0 if slides else float(np.linalg.norm(model.body_ipos[body] - model.jnt_pos[joint]))
    if arm < 1e-6:
        return []
    element = {"kind": "body", "name": model.body(body).name}
    return [{"name": "added_mass", "element": element, "parameters": {"mass": p["inertia"] / arm**2}}]
