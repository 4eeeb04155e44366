"""Files of mujoco.sysid as a study's recordings, and recordings as its files; both read by its own library."""

import mujoco
import numpy as np
import pytest
from importing_arm import ANGLE, SPEED, TIME, TORQUE, run
from mujoco.sysid._src import timeseries, trajectory

from det2stoc_bayes.engines.model_names import model_names
from det2stoc_bayes.errors import StudyError
from det2stoc_bayes.recording import read_recording
from det2stoc_bayes.study import load_study

SCENE = """<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="wrist" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 -0.3" size="0.03" mass="0.7" contype="0" conaffinity="0"/>
    </body>
    <body name="stone" pos="0 0 9"><freejoint name="float"/>
      <geom type="box" size="0.1 0.06 0.03" mass="0.8" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator><motor name="drive" joint="wrist"/></actuator>
  <sensor><framepos name="place" objtype="body" objname="stone"/></sensor>
</mujoco>
"""
PLACE = [f"sensor/place/{i}" for i in range(3)]
POSE = [f"qpos/float/{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]


@pytest.fixture
def study(tmp_path):
    """A study of one recording that mujoco.sysid's TimeSeries saved, a free body called by its body's name."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    number = len(TIME)
    pose = np.column_stack([TIME, 0 * TIME, 9 - TIME, np.cos(TIME), np.sin(TIME), 0 * TIME, 0 * TIME])
    data = np.column_stack([ANGLE, SPEED, pose, pose[:, :3]])
    kind = timeseries.SignalType
    signals = [("wrist", kind.MjStateQPos), ("wrist", kind.MjStateQVel), ("stone", kind.MjStateQPos), "place"]
    folder = tmp_path / "study"
    (folder / "recordings").mkdir(parents=True)
    (folder / "model.xml").write_text(SCENE)
    (folder / "study.toml").write_text('recordings = "recordings/*.npz"\n')
    series = timeseries.TimeSeries.from_names(TIME, data, model, signals)
    series.save_to_disk(folder / "recordings" / "swing.npz")
    assert series.data.shape == (number, 12)
    return folder


@pytest.mark.filterwarnings("ignore::det2stoc_bayes.recording.StudyWarning")
def test_a_time_series_is_a_recording(study):
    recording = load_study(study).recordings[0]
    assert recording.columns == ("qpos/wrist", "qvel/wrist", *POSE, *PLACE)
    np.testing.assert_allclose(recording.values[:, :2], np.column_stack([ANGLE, SPEED]))
    np.testing.assert_allclose(recording.values[:, 5], np.cos(TIME))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        ({"data": np.zeros((3, 12))}, r"found \(3, 12\) numbers at \(40,\) times"),
        ({"times": TIME[::-1]}, "row 2: found 0.38 after 0.39"),
        ({"times": np.full(40, np.nan)}, "no finite number"),
        ({"signal_mapping": np.asarray("[1]")}, "allowed: the JSON of mujoco.sysid"),
        ({"signal_mapping": np.asarray('{"wrist_qpos": [2, [99]]}')}, "column 99 of 12"),
        ({"signal_mapping": np.asarray('{"own": [1, [0]]}')}, "'own' is a CustomObs"),
        ({"signal_mapping": np.asarray('{"elbow_qpos": [2, [0]]}')}, "unknown column 'qpos/elbow'"),
        ({"data": np.array([{}], object)}, "no pickle"),
    ],
)
def test_other_files_are_refused(study, spoil, told):
    path = study / "recordings" / "swing.npz"
    with np.load(path) as content:
        arrays = dict(content) | spoil
    np.savez(path, **arrays)
    with pytest.raises(StudyError, match=told):
        load_study(study)


@pytest.fixture
def csv_study(tmp_path):
    model = "\n".join(line for line in SCENE.splitlines() if "sensor" not in line)
    (tmp_path / "recordings").mkdir()
    (tmp_path / "model.xml").write_text(model)
    (tmp_path / "study.toml").write_text("")
    lines = ["time,qpos/wrist,qvel/wrist,ctrl/drive"]
    lines += [
        f"{t},{'' if i == 7 else a},{v},{u}"
        for i, (t, a, v, u) in enumerate(zip(TIME, ANGLE, SPEED, TORQUE, strict=True))
    ]
    (tmp_path / "recordings" / "swing.csv").write_text("\n".join(lines))
    return tmp_path


def test_recordings_are_written_for_mujoco_sysid_and_read_again(csv_study):
    out = csv_study / "out"
    code, said = run("export-recordings", str(csv_study), "--to", "sysid", "--out", str(out))
    assert code == 0 and any("1 rows with a dropped sample are left out" in line for line in said), said
    assert any("qpos/float/x" in line and "not recorded" in line for line in said)
    model = mujoco.MjModel.from_xml_path(str(csv_study / "model.xml"))
    loaded = trajectory.SystemTrajectory.load_from_disk(out / "swing.npz", model, allow_missing_sensors=True)
    assert set(loaded.sensordata.signal_mapping) == {"wrist_qpos", "wrist_qvel"}
    kept = np.arange(len(TIME)) != 7
    np.testing.assert_allclose(loaded.sensordata.data, np.column_stack([ANGLE, SPEED])[kept])
    np.testing.assert_allclose(loaded.control.times, 0.005 * np.arange(79), atol=1e-12)
    np.testing.assert_allclose(loaded.control.data[:, 0], TORQUE[np.arange(79) // 2])  # held, a step each
    np.testing.assert_allclose(loaded.initial_state[[0, 1, 9]], [TIME[0], ANGLE[0], SPEED[0]])
    again = read_recording(out / "swing.npz", model_names(model))
    seen = again.values[~np.isnan(again.values).any(axis=1)]
    np.testing.assert_allclose(seen, np.column_stack([ANGLE, SPEED])[kept])


def test_a_free_body_is_called_by_its_body(study):
    out = study / "out"
    code, said = run("export-recordings", str(study), "--out", str(out))
    assert code == 0, said
    model = mujoco.MjModel.from_xml_string(SCENE)
    loaded = trajectory.SystemTrajectory.load_from_disk(out / "swing.npz", model, allow_missing_sensors=True)
    assert set(loaded.sensordata.signal_mapping) == {"wrist_qpos", "stone_qpos", "wrist_qvel", "place"}
