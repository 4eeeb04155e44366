"""Every format but those of test_learning_sets, from a small file that its own library wrote where there is one."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from importing_arm import ANGLE, ARM, SPEED, TIME, TORQUE
from mcap_ros2.writer import Writer as McapWriter
from mujoco.sysid._src import timeseries, trajectory
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from det2stoc_bayes.importers import FORMATS
from det2stoc_bayes.study import load_study

COLUMNS = ["time", "qpos/wrist", "qvel/wrist", "ctrl/drive"]


def test_csv_with_a_map_of_units_clock_phase_and_delay(place):
    lines = ["stamp,pos [deg],rate,cmd,note"]
    lines += [
        f"{1e3 * t + 5000},{np.degrees(a)},{v},{u},7" for t, a, v, u in zip(TIME, ANGLE, SPEED, TORQUE, strict=True)
    ]
    (place.folder / "swing.csv").write_text("\n".join(lines))
    (place.folder / "map.toml").write_text("""
clock = "ms"
phase = "before"
[settings]
time = "stamp"
[columns]
"qpos/wrist" = { signal = "pos", scale = -1.0, offset = 0.25 }
"qvel/wrist" = { signal = "rate", unit = "rad/s" }
"ctrl/drive" = { signal = "cmd", unit = "N m" }
""")
    (place.folder / "psi.toml").write_text("""[psi.damping]
target = "joint/wrist/damping"
prior = { LogNormal = { loc = -3.0, scale = 0.5 } }
""")
    code, said = place.imported(
        "csv", "swing.csv", "--map", str(place.folder / "map.toml"), "--psi", str(place.folder / "psi.toml")
    )
    assert code == 0, said
    header, rows = place.recording("swing")
    assert header == COLUMNS
    np.testing.assert_allclose(rows[:, :3], np.column_stack([TIME, 0.25 - ANGLE, SPEED]), atol=1e-9)
    np.testing.assert_allclose(rows[:-1, 3], TORQUE[1:])  # what acted up to a row's time acts from the row before
    assert [p.name for p in load_study(place.out).parameters] == ["damping"]
    told = (place.out / "SOURCE.md").read_text()
    assert "| swing | swing.csv | 40 | 0.39 | 5 |" in told and "`qpos/wrist` from `pos`, unit deg, times -1" in told


def test_delays_and_centred_controls_stand_at_times_of_their_own(place):
    lines = ["time [s],qpos/wrist [rad],ctrl/drive"]
    lines += [f"{t},{a},{u}" for t, a, u in zip(TIME, ANGLE, TORQUE, strict=True)]
    (place.folder / "swing.csv").write_text("\n".join(lines))
    code, said = place.imported("csv", "swing.csv", "--phase", "centred", "--unit", "ctrl/*=model")
    assert code == 0, said
    _, rows = place.recording("swing")
    acting = rows[~np.isnan(rows[:, 2])]
    np.testing.assert_allclose(acting[1:, 0], (TIME[1:] + TIME[:-1]) / 2, atol=1e-9)
    np.testing.assert_allclose(acting[:, 2], TORQUE)
    np.testing.assert_allclose(rows[~np.isnan(rows[:, 1]), 0], TIME, atol=1e-9)
    text = (place.out / "study.toml").read_text()
    assert "# [psi.wrist_damping]" in text and not load_study(place.out).parameters


def test_mujoco_sysid_rollouts_lose_their_late_stamp(place):
    model = mujoco.MjModel.from_xml_string(ARM)
    fine = model.opt.timestep * np.arange(60)
    control = timeseries.TimeSeries.from_control_names(fine, 0.1 * np.cos(9 * fine)[:, None], model)
    start = trajectory.create_initial_state(model, np.array([0.4]), np.array([0.0]))
    rolled = trajectory.sysid_rollout(model, mujoco.MjData(model), control, start)[0]
    rolled.save_to_disk(place.folder / "rolled.npz")
    code, said = place.imported("sysid", "rolled.npz")
    assert code == 0, said
    header, rows = place.recording("rolled")
    assert header == ["time", "qpos/wrist", "qvel/wrist", "sensor/encoder", "ctrl/drive"]
    both = rows[~np.isnan(rows[:, [1, 3]]).any(axis=1)]
    assert len(both) == 58
    np.testing.assert_array_equal(both[:, 1], both[:, 3])  # the encoder sees the position of its own time
    assert "moved" in (place.out / "SOURCE.md").read_text()


def test_a_lone_time_series_of_sensors_says_how_it_is_stamped(place):
    model = mujoco.MjModel.from_xml_string(ARM)
    timeseries.TimeSeries.from_names(TIME, ANGLE[:, None], model, ["encoder"]).save_to_disk(place.folder / "s.npz")
    code, said = place.imported("sysid", "s.npz")
    assert code == 2 and "give --set stamps=" in said[-1]
    assert place.imported("sysid", "s.npz", "--set", "stamps=measured")[0] == 0
    np.testing.assert_allclose(place.recording("s")[1], np.column_stack([TIME, ANGLE]), atol=1e-9)


JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
EPOCH, LATE = 1_700_000_000_000_000_000, 3_000_000  # ns; the bag gets a message 3 ms after its stamp


def test_an_mcap_of_joint_states(place):
    with (place.folder / "swing.mcap").open("wb") as file:
        writer = McapWriter(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        for t, a, v in zip(TIME, ANGLE, SPEED, strict=True):
            stamp = EPOCH + round(1e9 * t)
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
            message = {"header": header, "name": ["wrist", "gripper"], "position": [a, 0.0], "velocity": [v, 0.0]}
            writer.write_message("/joint_states", schema, message | {"effort": []}, stamp + LATE, stamp + LATE)
        writer.finish()
    assert place.imported("mcap", "swing.mcap")[0] == 2  # which clock?
    code, said = place.imported("mcap", "swing.mcap", "--clock", "header", "--delay", "qvel/wrist=0.002")
    assert code == 0, said
    header, rows = place.recording("swing")
    assert header == COLUMNS[:3]
    placed, moving = (rows[~np.isnan(rows[:, j])] for j in (1, 2))
    np.testing.assert_allclose(placed[:, :2], np.column_stack([TIME + 0.002, ANGLE]), atol=1e-9)
    np.testing.assert_allclose(moving[:, [0, 2]], np.column_stack([TIME, SPEED]), atol=1e-9)


def test_a_rosbag2_of_joint_states_and_commands(place):
    store = get_typestore(Stores.ROS2_HUMBLE)
    state, array = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
    empty = np.zeros(0)
    with BagWriter(place.folder / "bag", version=9) as bag:
        seen = bag.add_connection("/joint_states", state, typestore=store)
        sent = bag.add_connection("/commands", array, typestore=store)
        for t, a, u in zip(TIME, ANGLE, TORQUE, strict=True):
            stamp = EPOCH + round(1e9 * t)
            time = store.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
            header = store.types["std_msgs/msg/Header"](time, "")
            message = store.types[state](header, ["wrist"], np.array([a]), empty, empty)
            bag.write(seen, stamp, store.serialize_cdr(message, state))
            layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
            message = store.types[array](layout, np.array([u]))
            bag.write(sent, stamp + 1_000_000, store.serialize_cdr(message, array))
    more = ("--column", "ctrl/drive=/commands/0", "--unit", "ctrl/*=model", "--phase", "after")
    code, said = place.imported("mcap", "bag", "--clock", "header", *more)
    assert code == 2 and "has no header" in said[-1]
    code, said = place.imported("mcap", "bag", "--clock", "received", *more)
    assert code == 0, said
    _, rows = place.recording("bag")
    sent = rows[~np.isnan(rows[:, 2])]
    np.testing.assert_allclose(sent[:, 0], TIME[:-1] + 1e-3, atol=1e-9)  # after the last measurement nothing is told
    np.testing.assert_allclose(sent[:, 2], TORQUE[:-1])
    np.testing.assert_allclose(rows[~np.isnan(rows[:, 1]), 1], ANGLE)


def bam_log(**more) -> dict:
    """A log as bam's recorder writes it, PWM as unsigned counts."""
    rows = zip(TIME, ANGLE, SPEED, np.round(300 * TORQUE).astype(int), strict=True)
    entries = [
        {"position": a, "speed": v, "load": int(n) % 65536, "input_volts": 7.4, "temp": 29, "timestamp": t,
         "goal_position": 0.0, "torque_enable": True} for t, a, v, n in rows
    ]  # fmt: skip
    return {"mass": 0.49, "length": 0.1, "kp": 100, "motor": "xl330", "trajectory": "sin", "entries": entries} | more


def test_bam_logs(place):
    (place.folder / "run.json").write_text(json.dumps(bam_log()))
    more = ("--column", "qpos/wrist=position", "--column", "ctrl/drive=volts", "--phase", "after")
    code, said = place.imported("bam", "run.json", *more)
    assert code == 2 and "give --set pwm-limit=" in said[-1]
    code, said = place.imported("bam", "run.json", *more, "--set", "pwm-limit=885")
    assert code == 0, said
    _, rows = place.recording("run")
    np.testing.assert_allclose(rows, np.column_stack([TIME, ANGLE, np.round(300 * TORQUE) / 885 * 7.4]), atol=1e-9)
    assert "motor xl330, trajectory sin, kp 100" in (place.out / "SOURCE.md").read_text()


URDF = """<robot name="arm">
  <link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="hand"><inertial><mass value="0.5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://arm/meshes/hand.dae"/></geometry></visual>
    <collision><geometry><mesh filename="package://arm/meshes/hand.obj"/></geometry></collision></link>
  <joint name="wrist" type="revolute"><parent link="base"/><child link="hand"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="3"/><dynamics damping="0.2"/></joint>
</robot>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.mark.parametrize("base", ["fixed", "free"])
def test_a_urdf_becomes_the_model_of_a_study(place, base):
    (place.folder / "arm" / "meshes").mkdir(parents=True)
    (place.folder / "arm" / "meshes" / "hand.obj").write_text(TETRAHEDRON)
    (place.folder / "arm" / "arm.urdf").write_text(URDF)
    code, said = place.imported("urdf", "arm/arm.urdf", "--set", f"base={base}", "--set", "actuators=motor")
    assert code == 0, said
    model = mujoco.MjModel.from_xml_path(str(place.out / "model.xml"))
    assert (model.njnt, model.nu, model.joint("wrist").damping[0]) == ((1 if base == "fixed" else 2), 1, 0.2)
    assert model.actuator(0).name == "wrist" and model.nmesh == 1


def test_csv_recordings_of_a_urdf(place):
    (place.folder / "arm.urdf").write_text(
        URDF.replace('<mesh filename="package://arm/meshes/hand.obj"/>', '<sphere radius="0.1"/>')
    )
    (place.folder / "a.csv").write_text(
        "\n".join(["time [s],qpos/wrist [rad]", *(f"{t},{a}" for t, a in zip(TIME, ANGLE, strict=True))])
    )
    model = ("--model", str(place.folder / "arm.urdf"))
    code, said = place.imported("csv", "a.csv", *model)
    assert code == 2 and "give --set base=" in said[-1]
    assert place.imported("csv", "a.csv", *model, "--set", "base=fixed", "--set", "actuators=none")[0] == 0
    assert load_study(place.out).recordings[0].columns == ("qpos/wrist",)


def test_a_model_with_files_elsewhere_keeps_its_folders(place):
    (place.folder / "meshes").mkdir()
    (place.folder / "meshes" / "hand.obj").write_text(TETRAHEDRON)
    (place.folder / "robot").mkdir()
    asset = '<asset><mesh name="hand" file="../meshes/hand.obj"/></asset><worldbody>'
    (place.folder / "robot" / "arm.xml").write_text(ARM.replace("<worldbody>", asset))
    (place.folder / "a.csv").write_text(
        "\n".join(["time [s],qpos/wrist [rad]", *(f"{t},{a}" for t, a in zip(TIME, ANGLE, strict=True))])
    )
    code, said = place.imported("csv", "a.csv", "--model", str(place.folder / "robot" / "arm.xml"))
    assert code == 0, said
    assert load_study(place.out).model_path == place.out / "model" / "robot" / "arm.xml"


def test_every_format_is_documented_and_has_an_importer():
    text = (Path(__file__).parents[2] / "docs" / "importing.md").read_text()
    assert [name for name in (*FORMATS, "urdf") if f"`{name}`" not in text] == []
