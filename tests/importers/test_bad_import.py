"""Bad input of importers: one line that says what, where, found and allowed, exit code 2, nothing written."""

import json
import os

import h5py
import numpy as np
import pyarrow as pa
import pytest
from importing_arm import ANGLE, TIME
from pyarrow import parquet

GOOD = "\n".join(["time [s],qpos/wrist [rad]", *(f"{t},{a}" for t, a in zip(TIME, ANGLE, strict=True))])
BARE = GOOD.replace(" [s]", "").replace(" [rad]", "")
WITH_CONTROL = (
    GOOD.replace("qpos/wrist [rad]", "qpos/wrist [rad],ctrl/drive").replace("\n", ",1\n").replace("drive,1", "drive")
    + ",1"
)
ENTRIES = [{"timestamp": 0.01 * i, "position": 0.1 * i, "load": 3, "input_volts": 7.4} for i in range(9)]
COUNTED = json.dumps({"entries": ENTRIES})
SWITCHED_OFF = json.dumps({"entries": [*ENTRIES, ENTRIES[0] | {"timestamp": 1, "torque_enable": False}]})
FIXED = ("--set", "base=fixed", "--set", "actuators=none")
BY_NAME = ("--column", "qpos/wrist=position")


def text(name, content):
    return lambda folder: (folder / name).write_text(content)


def pickled(folder):
    np.savez(folder / "a.npz", times=np.array([{}], object), data=np.zeros((1, 1)))


def other_arrays(folder):
    np.savez(folder / "a.npz", x=TIME)


def backwards(folder):
    mapping = np.asarray(json.dumps({"wrist_qpos": [2, [0]]}))
    np.savez(folder / "a.npz", times=TIME[::-1], data=ANGLE[:, None], signal_mapping=mapping)


def no_mapping(folder):
    np.savez(folder / "a.npz", times=TIME, data=ANGLE[:, None])


def old_lerobot(folder):
    (folder / "set" / "meta").mkdir(parents=True)
    (folder / "set" / "meta" / "info.json").write_text('{"codebase_version": "v2.1", "features": {}}')


def lerobot_without_times(folder):
    (folder / "set" / "meta").mkdir(parents=True)
    (folder / "set" / "data" / "chunk-000").mkdir(parents=True)
    (folder / "set" / "meta" / "info.json").write_text('{"codebase_version": "v3.0", "features": {}}')
    parquet.write_table(pa.table({"episode_index": [0, 0]}), folder / "set" / "data" / "chunk-000" / "f.parquet")


def foreign_hdf5(folder):
    with h5py.File(folder / "a.hdf5", "w") as file:
        file["x"] = TIME


CASES = {
    "unknown format": ("cvs", text("a.csv", GOOD), "a.csv", (), "did you mean 'csv'"),
    "no such source": ("csv", text("a.csv", GOOD), "b.csv", (), "no such file"),
    "another suffix": ("csv", text("a.xlsx", GOOD), "a.xlsx", (), "allowed: .csv"),
    "no model": ("csv", text("a.csv", GOOD), "a.csv", ("--model", "none.xml"), "--model none.xml: no such file"),
    "unit not said": ("csv", text("a.csv", BARE), "a.csv", ("--clock", "s"), "give --unit qpos/wrist="),
    "clock not said": ("csv", text("a.csv", BARE), "a.csv", ("--unit", "*=rad"), "give --clock"),
    "phase not said": ("csv", text("a.csv", WITH_CONTROL), "a.csv", ("--unit", "ctrl/*=model"), "give --phase"),
    "clock of a format that says it": ("bam", text("a.json", COUNTED), "a.json", ("--clock", "s"), "bam does not take"),
    "period beside times": ("csv", text("a.csv", GOOD), "a.csv", ("--period", "1"), "has a column 'time' of times"),
    "delay of nothing": ("csv", text("a.csv", GOOD), "a.csv", ("--delay", "qvel/wrist=1"), "no such column is"),
    "delay that is no number": ("csv", text("a.csv", GOOD), "a.csv", ("--delay", "x=y"), "a number of seconds"),
    "unknown clock": ("csv", text("a.csv", BARE), "a.csv", ("--clock", "min", "--unit", "*=rad"), "allowed: s, ms"),
    "unknown phase": ("csv", text("a.csv", GOOD), "a.csv", ("--phase", "befor"), "did you mean 'before'"),
    "another quantity": ("csv", text("a.csv", GOOD), "a.csv", ("--unit", "*=mm"), "unit of length; allowed: rad"),
    "unknown unit": ("csv", text("a.csv", GOOD), "a.csv", ("--unit", "*=degree"), "did you mean 'deg'"),
    "unknown column": ("csv", text("a.csv", GOOD), "a.csv", ("--column", "qpos/wirst=x"), "did you mean 'qpos/wrist'"),
    "unknown signal": ("csv", text("a.csv", GOOD), "a.csv", ("--column", "qpos/wrist=angel"), "no signal 'angel'"),
    "no column of the model": ("csv", text("a.csv", GOOD.replace("qpos/wrist", "q")), "a.csv", (), "give --column"),
    "option without =": ("csv", text("a.csv", GOOD), "a.csv", ("--column", "qpos/wrist"), "allowed: COLUMN=SIGNAL"),
    "unknown setting": ("csv", text("a.csv", GOOD), "a.csv", ("--set", "tiem=t"), "did you mean 'time'"),
    "text in a cell": ("csv", text("a.csv", GOOD + "\n0.5,lost"), "a.csv", (), "row 42: column qpos/wrist: found"),
    "a cell too many": ("csv", text("a.csv", GOOD + "\n0.5,1,2"), "a.csv", (), "row 42: found 3 cells"),
    "times that go back": ("csv", text("a.csv", GOOD + "\n0.1,1"), "a.csv", (), "row 41: found 0.1 after 0.39"),
    "no times": ("csv", text("a.csv", GOOD.replace("time [s]", "t")), "a.csv", (), "give --set time=NAME or --period"),
    "map with an unknown key": ("csv", text("a.csv", GOOD), "a.csv", ("--map", "map.toml"), "did you mean 'columns'"),
    "psi with an unknown key": ("csv", text("a.csv", GOOD), "a.csv", ("--psi", "psi.toml"), "psi.toml: model: unknown"),
    "psi of another model": ("csv", text("a.csv", GOOD), "a.csv", ("--psi", "elbow.toml"), "no joint named 'elbow'"),
    "holdout of all": ("csv", text("a.csv", GOOD), "a.csv", ("--holdout", "*"), "matches 1 of 1"),
    "only of none": ("csv", text("a.csv", GOOD), "a.csv", ("--only", "b*"), "no recording has such a name"),
    "a quaternion's worth of degrees": ("csv", text("a.csv", GOOD + "\n0.5,1e13"), "a.csv", (), "makes no study"),
    "npz with a pickle": ("sysid", pickled, "a.npz", (), "no pickle"),
    "npz of something else": ("sysid", other_arrays, "a.npz", (), "found arrays x; allowed: times"),
    "npz without names": ("sysid", no_mapping, "a.npz", (), "no signal_mapping"),
    "npz that goes back": ("sysid", backwards, "a.npz", (), "row 2"),
    "no npz": ("sysid", text("a.npz", "zip"), "a.npz", (), "cannot be read"),
    "old LeRobot": ("lerobot", old_lerobot, "set", (), "codebase_version: found 'v2.1'"),
    "no LeRobot": ("lerobot", text("a.csv", GOOD), ".", (), "no meta/info.json"),
    "LeRobot without times": ("lerobot", lerobot_without_times, "set", (), "no column timestamp"),
    "no bag": ("mcap", text("a.mcap", "bag"), "a.mcap", ("--clock", "header"), "cannot be read"),
    "bag without a clock": ("mcap", text("a.mcap", "bag"), "a.mcap", (), "--clock: found nothing"),
    "no HDF5": ("robomimic", text("a.hdf5", "h5"), "a.hdf5", (), "cannot be read"),
    "HDF5 of something else": ("robomimic", foreign_hdf5, "a.hdf5", (), "groups data/demo_0"),
    "Minari of something else": ("minari", foreign_hdf5, "a.hdf5", (), "groups episode_0"),
    "no JSON": ("bam", text("a.json", "{"), "a.json", BY_NAME, "cannot be read"),
    "JSON of something else": ("bam", text("a.json", "[1]"), "a.json", BY_NAME, "found list"),
    "counted load": ("bam", text("a.json", COUNTED), "a.json", BY_NAME, "give --set pwm-limit="),
    "a motor that is switched off": (
        "bam", text("a.json", SWITCHED_OFF),
        "a.json", BY_NAME, "give --set torque=",
    ),
    "no URDF": ("urdf", text("a.urdf", "<mujoco/>"), "a.urdf", FIXED, "found <mujoco>"),
    "URDF without its base": ("urdf", text("a.urdf", "<robot/>"), "a.urdf", (), "give --set base="),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_it_is_refused_in_one_line(place, case, monkeypatch):
    form, make, source, more, told = CASES[case]
    make(place.folder)
    (place.folder / "map.toml").write_text("colums = {}\n")
    (place.folder / "psi.toml").write_text('model = "other.xml"\n')
    prior = "prior = { Normal = { loc = 0.0, scale = 1.0 } }"
    (place.folder / "elbow.toml").write_text(f'[psi.x]\ntarget = "joint/elbow/damping"\n{prior}\n')
    monkeypatch.chdir(place.folder)
    before = sorted(os.listdir(place.folder))
    code, said = place.imported(form, source, *more)
    errors = [line for line in said if not line.startswith("warning: ")]
    assert code == 2 and len(errors) == 1, said
    assert (
        errors[0].startswith("error: ") and told in errors[0] and ("allowed: " in errors[0] or "did you" in errors[0])
    )
    assert sorted(os.listdir(place.folder)) == before


def test_a_folder_with_files_is_not_written_to(place):
    (place.folder / "a.csv").write_text(GOOD)
    place.out.mkdir()
    (place.out / "mine.txt").write_text("mine")
    code, said = place.imported("csv", "a.csv")
    assert code == 2 and "found files in it" in said[-1]
    assert os.listdir(place.out) == ["mine.txt"]
