"""What an effects.py has besides the laws: source that is copied there and needs only mujoco and numpy.

`effects_module` fills the tables below. It relies on time, qpos, qvel, act, ctrl and the applied forces alone.
"""

from weakref import WeakKeyDictionary

import mujoco
import numpy as np

FIELDS: tuple = ()  # (field, rows, values)
MOMENTARY: tuple = ()  # (kind, name, law, parameters, fields that the law writes, fields that it looks at)
CLOCKS: tuple = ()  # ratios of the recorded clock to true time
CONTROLS: tuple = ()  # (actuator, law, parameters, seconds of commands that the law looks back on)
SAMPLE_TIMES: tuple = ()  # (column or "time", law, parameters)
READINGS: tuple = ()  # (column or "time", law, parameters)


class Memory:
    """What is remembered of one data object's past."""

    def __init__(self, model):
        self.model, self.scratch, self.time = model, mujoco.MjData(model), None
        self.commands, self.states, self.speeds, self.anchors = [], [], [], {}


MEMORIES = WeakKeyDictionary()
BELIEVED = WeakKeyDictionary()  # model -> fields as they are without what is rewritten at every step


def memory_of(model, data):
    """The memory of a data object."""
    memory = MEMORIES.get(data)
    if memory is None or memory.model is not model:
        memory = MEMORIES[data] = Memory(model)
    return memory


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


def keep_clock(model, data):
    """Lets data.time show the recorded clock, a step of which is not a step of true time."""
    memory, true = memory_of(model, data), model.opt.timestep
    if memory.time is not None and abs(data.time - memory.time - true) < 1e-3 * true:
        data.time = memory.time + true * np.prod(CLOCKS)
    memory.time = data.time


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

    A column that no effect changes has its plain value, `ctrl/...` the command. Sensors are evaluated for the present
    state, with the forces and controls of the last step.
    """
    now = arrays(model, data, any(column.startswith("sensor/") for column in columns))
    recorded = {}
    for column in columns:
        if column == "time" or column.startswith("ctrl/"):
            recorded[column] = float(given(model, data, column))
            continue
        source, index = place_of(model, column)
        time = np.array([data.time])
        for _, law, p in (e for e in SAMPLE_TIMES if e[0] in (column, "time")):
            time = law(p, time, np)
        value = at_time(memory_of(model, data).states, data.time, now, time, source, index)
        for _, law, p in (e for e in READINGS if e[0] in (column, "time")):
            value = law(p, np.array([data.time]), value, np)
        recorded[column] = float(value[0])
    return recorded


def given(model, data, column):
    """What a recording has beside states: its time, and what was commanded, whatever arrives at the actuators."""
    if column == "time":
        return data.time
    commands = memory_of(model, data).commands
    return (commands[-1][1] if commands else data.ctrl)[model.actuator_ctrladr[model.actuator(column[5:]).id]]


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
        copy_state(model, data, scratch := memory_of(model, data).scratch)
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
