"""Which recorded columns are a coordinate of the state itself, sensors that only repeat one included."""

import mujoco
import numpy as np

from det2stoc_bayes.engines.layout import column_address

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_SENSOR, _OBJECT = mujoco.mjtSensor, mujoco.mjtObj
_ONE_JOINT = {  # sensors of a joint: source, first component
    int(_SENSOR.mjSENS_JOINTPOS): "qpos",
    int(_SENSOR.mjSENS_JOINTVEL): "qvel",
    int(_SENSOR.mjSENS_BALLQUAT): "qpos",
    int(_SENSOR.mjSENS_BALLANGVEL): "qvel",
}
_FRAME = {  # sensors of a frame that is a free body's own: source, first component of the free joint
    int(_SENSOR.mjSENS_FRAMEPOS): ("qpos", 0),
    int(_SENSOR.mjSENS_FRAMEQUAT): ("qpos", 3),
    int(_SENSOR.mjSENS_FRAMELINVEL): ("qvel", 0),
    int(_SENSOR.mjSENS_GYRO): ("qvel", 3),
}


def state_columns(model: mujoco.MjModel, columns: tuple[str, ...]) -> dict[tuple[str, int], int]:
    """(`qpos` or `qvel`, index) -> number of the column that is this coordinate; a joint's own column goes first."""
    found: dict[tuple[str, int], int] = {}
    for own in (True, False):
        for j, column in enumerate(columns):
            if column.startswith("sensor/") != own:
                place = _place(model, column)
                if place is not None:
                    found.setdefault(place, j)
    return found


def _place(model: mujoco.MjModel, column: str) -> tuple[str, int] | None:
    where = column_address(model, column)
    if where.source != "sensordata":
        return where.source, where.index
    sensor = int(np.flatnonzero(model.sensor_adr <= where.index)[-1])
    part, kind = where.index - int(model.sensor_adr[sensor]), int(model.sensor_type[sensor])
    if model.sensor_cutoff[sensor] > 0:
        return None  # clipped
    if kind in _ONE_JOINT:
        source, joint = _ONE_JOINT[kind], int(model.sensor_objid[sensor])
        return source, int((model.jnt_qposadr if source == "qpos" else model.jnt_dofadr)[joint]) + part
    if kind not in _FRAME or model.sensor_refid[sensor] >= 0:
        return None
    joint = _free_joint(model, sensor)
    if joint is None:
        return None
    source, first = _FRAME[kind]
    return source, int((model.jnt_qposadr if source == "qpos" else model.jnt_dofadr)[joint]) + first + part


def _free_joint(model: mujoco.MjModel, sensor: int) -> int | None:
    """The free joint whose body frame is the sensor's."""
    number, kind = int(model.sensor_objid[sensor]), int(model.sensor_objtype[sensor])
    if kind == int(_OBJECT.mjOBJ_XBODY):
        body, pos, quat = number, np.zeros(3), np.array([1.0, 0, 0, 0])
    elif kind == int(_OBJECT.mjOBJ_BODY):
        body, pos, quat = number, model.body_ipos[number], model.body_iquat[number]
    elif kind == int(_OBJECT.mjOBJ_SITE):
        body, pos, quat = int(model.site_bodyid[number]), model.site_pos[number], model.site_quat[number]
    else:
        return None
    joint = int(model.body_jntadr[body])
    same = not pos.any() and abs(quat[0]) == 1.0
    return joint if same and joint >= 0 and model.jnt_type[joint] == _FREE else None


def quaternion_address(model: mujoco.MjModel, joint: int) -> int | None:
    """Index into qpos of a free or ball joint's quaternion, None for other joints."""
    shift = {_FREE: 3, _BALL: 0}.get(int(model.jnt_type[joint]))
    return None if shift is None else int(model.jnt_qposadr[joint]) + shift
