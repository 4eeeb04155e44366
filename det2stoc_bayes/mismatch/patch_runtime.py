"""What an effects.py has besides the laws: source that is copied there and needs only mujoco and numpy.

`effects_module` fills the tables below, which are empty here. Of the data it relies on time, qpos, qvel, act,
ctrl and the applied forces alone.
"""

from types import SimpleNamespace
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

FIELDS: tuple = ()  # (field, rows, values)
JOINT_FORCES: tuple = ()  # (joint, law, parameters)
BODY_FORCES: tuple = ()  # (body, law, parameters)
MOMENTARY: tuple = ()  # (kind, name, law, parameters, fields that the law writes, fields that it looks at)
CLOCKS: tuple = ()  # ratios of the recorded clock to true time
CONTROLS: tuple = ()  # (actuator, law, parameters, seconds of commands that the law looks back on)
SAMPLE_TIMES: tuple = ()  # (column or "time", law, parameters)
READINGS: tuple = ()  # (column or "time", law, parameters)


class Memory:
    """What is remembered of one data object's past."""

    def __init__(self, model):
        self.model, self.scratch, self.time = model, mujoco.MjData(model), None
        self.commands, self.states, self.speeds = [], [], []


MEMORIES = WeakKeyDictionary()
BELIEVED = WeakKeyDictionary()  # model -> fields as they are without what is rewritten at every step


def memory_of(model, data):
    """The memory of a data object."""
    memory = MEMORIES.get(data)
    if memory is None or memory.model is not model:
        memory = MEMORIES[data] = Memory(model)
    return memory


def add_joint_forces(model, data):
    """Adds to qfrc_applied, held over a step."""
    for name, law, p in JOINT_FORCES:
        joint = model.joint(name).id
        dof = model.jnt_dofadr[joint]
        data.qfrc_applied[dof] += np.asarray(law(p, joint_state(model, data, joint), np)).item()


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
        at = SimpleNamespace(dof=dof, actuators=actuators)
        for field, value in law(p, fields, state, at, np).items():
            set_field(model, field, value)


def restore_fields(model):
    """Undoes what was written for a step."""
    for field, value in BELIEVED.pop(model, {}).items():
        set_field(model, field, value)


def field_of(model, name):
    """A model field by name, as dof_frictionloss or opt.wind."""
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)


def set_field(model, name, value):
    """Sets a whole array."""
    field_of(model, name)[:] = value


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


def keep_clock(model, data):
    """Lets data.time show the recorded clock, a step of which is not a step of true time."""
    memory, true = memory_of(model, data), model.opt.timestep
    if memory.time is not None and abs(data.time - memory.time - true) < 1e-3 * true:
        data.time = memory.time + true * np.prod(CLOCKS)
    memory.time = data.time


def add_body_forces(model, data):
    """Adds to xfrc_applied, which acts at the centre of mass; its velocity is computed beside `data`."""
    scratch = memory_of(model, data).scratch
    copy_state(model, data, scratch)
    lead, middle = lead_of(model), middle_speed(model, data)
    mujoco.mj_integratePos(model, scratch.qpos, 0.5 * (data.qvel + middle), lead)
    scratch.qvel[:] = middle
    mujoco.mj_kinematics(model, scratch)
    mujoco.mj_comPos(model, scratch)
    mujoco.mj_comVel(model, scratch)
    velocity = np.empty(6)  # angular, then linear, in the world frame
    for name, law, p in BODY_FORCES:
        body = model.body(name).id
        mujoco.mj_objectVelocity(model, scratch, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        geoms = np.flatnonzero(model.geom_bodyid == body)
        shapes, sizes = tuple(model.geom_type[geoms].tolist()), model.geom_size[geoms]
        moving = {"velocity": velocity[3:].copy(), "spin": velocity[:3].copy()}
        state = SimpleNamespace(**moving, t=data.time + lead, shapes=shapes, sizes=sizes)
        data.xfrc_applied[body, :3] += law(p, state, np)


def rewrite_controls(model, data):
    """Replaces commands by what arrives at the actuators."""
    commands, dt = memory_of(model, data).commands, model.opt.timestep
    tick = dt * np.prod(CLOCKS)  # a step of the recorded clock
    # Each law looks back on what the one before it gave out: the steps add up.
    length = 1 + sum(int(np.ceil(seconds / dt)) + 2 for _, _, _, seconds in CONTROLS)
    missed = follow(commands, data.time, tick)
    commands.extend(commands[-1:] * min(missed, length))  # a command is held until the next
    commands.append((data.time, data.ctrl.copy()))
    del commands[:-length]
    past = np.array([u for _, u in commands])
    past = np.concatenate([np.repeat(past[:1], length - len(past), 0), past])
    times = data.time + tick * np.arange(1 - length, 1)
    for name, law, p, _ in CONTROLS:
        place = model.actuator_ctrladr[model.actuator(name).id]
        past[:, place] = law(p, past[:, place], times, dt, np)
        data.ctrl[place] = past[-1, place]


def follow(past, time, dt):
    """Drops what does not precede `time` from a list of (time, value); gives how many steps were left out."""
    steps = round((time - past[-1][0]) / dt) if past else 1
    if steps < 0:
        past.clear()
    elif steps == 0:
        past.pop()
    return max(steps - 1, 0) if past else 0


def remember_state(model, data):
    """Keeps the states that the laws of time can still ask for."""
    states = memory_of(model, data).states
    follow(states, data.time, model.opt.timestep * np.prod(CLOCKS))
    sensors = any(column == "time" or column.startswith("sensor/") for column, _, _ in SAMPLE_TIMES)
    states.append((data.time, arrays(model, data, sensors)))
    oldest = min(float(np.min(law(p, np.array([data.time]), np))) for _, law, p in SAMPLE_TIMES)
    while len(states) > 2 and states[1][0] < oldest - 2 * model.opt.timestep:
        states.pop(0)


def measure(model, data, columns):
    """What is recorded now for each of the columns, as qpos/elbow, qvel/base/wx or sensor/force/0.

    A column that no effect changes has its plain value. Sensors are evaluated for the present state, with the
    forces and controls of the last step.
    """
    now = arrays(model, data, any(column.startswith("sensor/") for column in columns))
    recorded = {}
    for column in columns:
        source, index = place_of(model, column)
        time = np.array([data.time])
        for _, law, p in (e for e in SAMPLE_TIMES if e[0] in (column, "time")):
            time = law(p, time, np)
        value = at_time(memory_of(model, data).states, data.time, now, time, source, index)
        for _, law, p in (e for e in READINGS if e[0] in (column, "time")):
            value = law(p, np.array([data.time]), value, np)
        recorded[column] = float(value[0])
    return recorded


def at_time(states, now_time, now, time, source, index):
    """A column's value at another time: linear between steps; before the first along three steps' parabola at first."""
    past = [s for s in states if s[0] < now_time - 1e-9] + [(now_time, now)]
    if len(past) == 1 or time[0] == now_time:
        return now[source][index : index + 1]
    times, values = np.array([t for t, _ in past]), np.array([a[source][index] for _, a in past])
    k = int(np.clip(np.searchsorted(times, time[0]) - 1, 0, len(times) - 2))
    share = (time - times[k]) / (times[k + 1] - times[k])
    bend = 0.5 * np.diff(values[:3], 2).sum() * (b := np.clip(share, -10, 0)) * (b - 1)
    return (1 - share) * values[k] + share * values[k + 1] + bend


def arrays(model, data, sensors):
    """Copies of the arrays that columns are read from."""
    found = {"qpos": data.qpos.copy(), "qvel": data.qvel.copy()}
    if sensors and model.nsensordata:
        scratch = memory_of(model, data).scratch
        copy_state(model, data, scratch)
        mujoco.mj_forward(model, scratch)
        found["sensor"] = scratch.sensordata.copy()
    return found


def copy_state(model, data, other):
    """Everything that a simulation goes on from, derived quantities excluded."""
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    mujoco.mj_setState(model, other, state, kind)


def place_of(model, column):
    """Array and index of a column."""
    source, _, name = column.partition("/")
    kind = mujoco.mjtObj.mjOBJ_SENSOR if source == "sensor" else mujoco.mjtObj.mjOBJ_JOINT
    part = ""
    if mujoco.mj_name2id(model, kind, name) < 0:
        name, _, part = name.rpartition("/")
    if source not in ("qpos", "qvel", "sensor") or mujoco.mj_name2id(model, kind, name) < 0:
        raise KeyError(f"no column '{column}'; allowed: qpos/ or qvel/ and a joint, sensor/ and a sensor")
    if source == "sensor":
        return source, model.sensor(name).adr[0] + int(part or 0)
    joint = model.joint(name)
    parts = ["x", "y", "z", "qw", "qx", "qy", "qz"] if source == "qpos" else ["vx", "vy", "vz", "wx", "wy", "wz"]
    if joint.type[0] == mujoco.mjtJoint.mjJNT_BALL:
        parts = parts[3:]
    first = joint.qposadr[0] if source == "qpos" else joint.dofadr[0]
    return source, first + (parts.index(part) if part else 0)


def write_fields(model):
    """Writes what MJCF cannot express; again gives the same."""
    for name, rows, values in FIELDS:
        if rows:
            field_of(model, name)[list(rows)] = values
        else:
            setattr(model.opt, name[4:], values)
    mujoco.mj_setConst(model, mujoco.MjData(model))


def reset(model, data):
    """After each reset of `data`: forgets its past."""
    MEMORIES.pop(data, None)
