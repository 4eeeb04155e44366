"""Forces in an effects.py besides the laws: source that is copied there, as that of `patch_runtime`."""

from types import SimpleNamespace

import mujoco
import numpy as np

from det2stoc_bayes.mismatch.patch_contact import place_contact
from det2stoc_bayes.mismatch.patch_runtime import (
    BELIEVED,
    CLOCKS,
    MOMENTARY,
    copy_state,
    field_of,
    follow,
    memory_of,
    set_field,
)

JOINT_FORCES: tuple = ()  # (joint, law, parameters, what the law needs beside them)
BODY_FORCES: tuple = ()  # (body or "world", law of the force, law of the torque or None, parameters)


def lead_of(model):
    """How far into a step its forces are taken: RK4 weighs the whole step, so that it gets the middle's."""
    return 0.5 * model.opt.timestep if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.0


def remember_speed(model, data):
    """Keeps the speeds of this step and of the one before it."""
    speeds = memory_of(model, data).speeds
    missed = follow(speeds, data.time, model.opt.timestep * np.prod(CLOCKS))
    speeds[:] = [*([] if missed else speeds[-1:]), (data.time, data.qvel.copy())]


def middle_speed(model, data):
    """Speeds where the step's forces are taken, as the last step's change foretells them."""
    speeds = memory_of(model, data).speeds
    ahead = 0.5 if lead_of(model) and len(speeds) > 1 else 0.0
    return data.qvel + ahead * (data.qvel - speeds[0][1])


def joint_state(model, data, joint):
    """A joint's position, speed and time."""
    lead = lead_of(model)
    time = np.float64(data.time + lead)
    if joint < 0:
        return SimpleNamespace(q=0.0, v=0.0, t=time)
    v, dof = middle_speed(model, data), model.jnt_dofadr[joint]
    way = lead * 0.5 * (data.qvel[dof] + v[dof])
    return SimpleNamespace(q=data.qpos[model.jnt_qposadr[joint]] + way, v=v[dof], t=time)


def drive_of(model, data, joint, actuators):
    """What the actuators of a joint are given: coefficients, limits, inputs."""
    ids = list(actuators)
    affine = model.actuator_gaintype[ids] == mujoco.mjtGain.mjGAIN_AFFINE
    gain = model.actuator_gainprm[ids, :3] * np.where(affine[:, None], 1.0, [1.0, 0, 0])
    biased = model.actuator_biastype[ids] == mujoco.mjtBias.mjBIAS_AFFINE
    free = np.where(model.actuator_forcelimited[ids][:, None], 0.0, [-np.inf, np.inf])
    low, high = (np.where(free != 0, free, model.actuator_forcerange[ids])).T
    clamped = model.actuator_ctrllimited[ids].astype(bool)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        clamped[:] = False
    u, limits = data.ctrl[model.actuator_ctrladr[ids]], model.actuator_ctrlrange[ids]
    u = np.where(clamped, np.clip(u, limits[:, 0], limits[:, 1]), u)
    last = model.actuator_actadr[ids] + model.actuator_actnum[ids] - 1
    for k, number in enumerate(model.actuator_actnum[ids]):
        u[k] = data.act[last[k]] if number else u[k]
    bounded = model.jnt_actfrclimited[joint]
    least, most = model.jnt_actfrcrange[joint] if bounded else (-np.inf, np.inf)
    gear, bias = model.actuator_gear[ids, 0], model.actuator_biasprm[ids, :3] * biased[:, None]
    return SimpleNamespace(gain=gain, bias=bias, gear=gear, low=low, high=high, u=u, least=least, most=most)


def joint_and_actuators(model, kind, name):
    """Numbers of an element's joint (-1: none) and of the actuators that concern it."""
    if kind == "actuator":
        actuator = model.actuator(name).id
        return model.actuator_trnid[actuator, 0], (actuator,)
    if kind == "joint":
        joint, on_joint = model.joint(name).id, (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        known = np.isin(model.actuator_trntype, [int(t) for t in on_joint])
        return joint, tuple(np.flatnonzero(known & (model.actuator_trnid[:, 0] == joint)).tolist())
    return -1, ()


def rewrite_fields(model, data):
    """Writes model fields for the step that begins; reset undoes it."""
    believed = BELIEVED.setdefault(model, {})
    for *_, written, _ in MOMENTARY:
        for field in written:
            believed.setdefault(field, np.array(field_of(model, field)))
            set_field(model, field, believed[field])
    for kind, name, law, p, written, seen in MOMENTARY:
        joint, actuators = joint_and_actuators(model, kind, name)
        state = joint_state(model, data, joint)
        state.drive = drive_of(model, data, joint, actuators) if actuators else None
        dof = model.jnt_dofadr[joint] if joint >= 0 else -1
        fields = {field: np.array(field_of(model, field)) for field in (*written, *seen)}
        at = SimpleNamespace(dof=dof, actuators=actuators, kind=kind)
        place_contact(model, data, name, at, state)
        for field, value in law(p, fields, state, at, np).items():
            set_field(model, field, value)


def add_joint_forces(model, data):
    """Adds to qfrc_applied, held over a step."""
    for number, (name, law, p, beside) in enumerate(JOINT_FORCES):
        joint, actuators = joint_and_actuators(model, "joint", name)
        state = joint_state(model, data, joint)
        if "driven" in beside:
            state.drive = drive_of(model, data, joint, actuators)
        if "anchor" in beside:
            anchors, begin = memory_of(model, data).anchors, data.qpos[model.jnt_qposadr[joint]]
            state.anchor = anchors[number] = beside["anchor"](p, state.q, anchors.get(number, begin), np)
        if "source" in beside:
            other = model.joint(beside["source"]).id
            state.source = joint_state(model, data, other)
            data.qfrc_applied[model.jnt_dofadr[other]] += np.asarray(beside["reaction"](p, state, np)).item()
        data.qfrc_applied[model.jnt_dofadr[joint]] += np.asarray(law(p, state, np)).item()


def add_body_forces(model, data):
    """Adds to xfrc_applied, which acts at the centre of mass; its motion is computed beside `data`."""
    scratch = memory_of(model, data).scratch
    copy_state(model, data, scratch)
    lead, middle = lead_of(model), middle_speed(model, data)
    mujoco.mj_integratePos(model, scratch.qpos, 0.5 * (data.qvel + middle), lead)
    scratch.qvel[:] = middle
    mujoco.mj_kinematics(model, scratch)
    mujoco.mj_comPos(model, scratch)
    mujoco.mj_comVel(model, scratch)
    for name, law, turn, p in BODY_FORCES:
        for body in [model.body(name).id] if model.body(name).id else np.flatnonzero(model.body_mass > 0):
            state = body_state(model, scratch, body, data.time + lead)
            data.xfrc_applied[body, :3] += law(p, state, np)
            if turn is not None:
                data.xfrc_applied[body, 3:] += turn(p, state, np)


def body_state(model, data, body, time):
    """A body's motion and mass, in the world frame."""
    velocity = np.empty(6)  # angular, then linear
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
    geoms, axes = np.flatnonzero(model.geom_bodyid == body), data.ximat[body].reshape(3, 3)
    state = SimpleNamespace(t=time, velocity=velocity[3:].copy(), spin=velocity[:3].copy())
    state.shapes, state.sizes = tuple(model.geom_type[geoms].tolist()), model.geom_size[geoms]
    state.position, state.mass = data.xipos[body].copy(), model.body_mass[body]
    state.inertia = (axes * model.body_inertia[body]) @ axes.T
    return state
