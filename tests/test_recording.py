"""Recordings: what is read, what is refused, what is told."""

import pickle
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pyarrow import parquet

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import StudyError
from det2stoc_bayes.recording import StudyWarning, read_recording

CUBE = tuple(f"qpos/cube/{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz"))
QUATERNION = ",".join(CUBE[3:])
NAMES = ModelNames(
    columns=("qpos/slide", "qvel/slide", "qpos/elbow", "qvel/elbow", "qpos/wheel", *CUBE, "sensor/gyro/0"),
    actuators=("motor", "", "servo"),
    elements={},
    fields={},
    quaternions=(tuple(f"qpos/cube/{p}" for p in ("qw", "qx", "qy", "qz")),),
    hinges={"qpos/elbow": (-1.5, 1.5), "qpos/wheel": None},
)


def read(folder: Path, text: str, name: str = "drop.csv"):
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text, encoding="utf-8")
    return read_recording(folder / name, NAMES)


def test_reads_columns_controls_and_dropped_samples(tmp_path: Path):
    text = "\ufefftime, qvel/slide ,ctrl/servo,qpos/slide\r\n0,1,,2\r\n\r\n.1,,3,-2.5e-3\r\n.3,4,,+.5\r\n.4,,5,1"
    recording = read(tmp_path, text)
    assert recording.name == "drop"
    assert recording.columns == ("qvel/slide", "qpos/slide")
    np.testing.assert_array_equal(recording.time, [0, 0.1, 0.3, 0.4])
    np.testing.assert_array_equal(recording.values, [[1, 2], [np.nan, -2.5e-3], [4, 0.5], [np.nan, 1]])
    np.testing.assert_array_equal(recording.ctrl, [[0, 0, 3], [0, 0, 3], [0, 0, 3], [0, 0, 5]])
    with pytest.raises(ValueError, match="read-only"):
        recording.values[0] = 0
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(recording)).time, recording.time)


@pytest.mark.filterwarnings("ignore:.*constant")
def test_quaternions_become_unit_and_lose_incomplete_samples(tmp_path: Path):
    with pytest.warns(StudyWarning, match="1 quaternions with an empty component are dropped"):
        recording = read(tmp_path, f"time,{QUATERNION}\n0,1.004,0,0,0\n1,0,,0,1\n2,-0.6,0.8,0,0\n")
    expected = [[1, 0, 0, 0], [np.nan] * 4, [-0.6, 0.8, 0, 0]]
    np.testing.assert_allclose(recording.values, expected, rtol=1e-15)


def test_parquet_is_read_alike(tmp_path: Path):
    table = {"time": [0, 1, 2], "qpos/slide": [0.5, None, 1.5], "ctrl/motor": [None, 2, None]}
    parquet.write_table(pa.table(table), tmp_path / "drop.parquet")
    recording = read_recording(tmp_path / "drop.parquet", NAMES)
    np.testing.assert_array_equal(recording.values, [[0.5], [np.nan], [1.5]])
    np.testing.assert_array_equal(recording.ctrl[:, 0], [2, 2, 2])


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    steps=hnp.arrays(float, st.integers(2, 12), elements=st.floats(1e-6, 1e3)),
    data=st.data(),
)
def test_round_trip(tmp_path: Path, steps: np.ndarray, data: st.DataObject):
    time = np.cumsum(steps)
    columns = ("qpos/slide", "sensor/gyro/0")
    number = st.none() | st.floats(-1e12, 1e12)
    rows = data.draw(st.lists(st.tuples(number, number), min_size=len(time), max_size=len(time)))
    rows[0] = (1.0, -2.0)  # a column without any value is an error
    lines = [
        ",".join("" if x is None else repr(x) for x in (float(t), *row)) for t, row in zip(time, rows, strict=True)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StudyWarning)
        recording = read(tmp_path, "\n".join([f"time,{','.join(columns)}", *lines]))
    np.testing.assert_array_equal(recording.time, time)
    np.testing.assert_array_equal(recording.values, np.array(rows, float))


GOOD = "time,qpos/slide,qvel/slide\n0,1,2\n"
MISTAKES = {
    "empty file": ("", "empty file", "a header"),
    "blank file": ("\n\n", "empty file", "a header"),
    "header only": ("time,qpos/slide\n", "no sample", "at least 2"),
    "single sample": (GOOD, "a single sample", "at least 2"),
    "no time": ("t,qpos/slide\n0,1\n1,2\n", "no column 'time'; found t, qpos/slide", "allowed: time"),
    "semicolons": ("time;qpos/slide\n0;1\n1;2\n", "time;qpos/slide", "separated by commas"),
    "no measured column": ("time,ctrl/motor\n0,1\n1,2\n", "no measured column", "qpos/slide"),
    "duplicate": ("time,qpos/slide,qpos/slide\n0,1,1\n1,2,2\n", "'qpos/slide' 2 times", "each name once"),
    "unknown": ("time,qpos/slid\n0,1\n1,2\n", "unknown column 'qpos/slid'", "did you mean 'qpos/slide'?"),
    "unnamed": (",time,qpos/slide\n0,0,1\n1,1,2\n", "unknown column ''", "qpos/slide"),
    "unknown control": ("time,qpos/slide,ctrl/moter\n0,1,1\n", "ctrl/moter", "did you mean 'ctrl/motor'?"),
    "text": (GOOD + "1,abc,2\n", "line 3: column qpos/slide: found 'abc'", "a finite number"),
    "nan": (GOOD + "1,nan,2\n", "line 3: column qpos/slide: found 'nan'", "a finite number, or nothing"),
    "infinite": (GOOD + "1,1,-inf\n", "line 3: column qvel/slide: found '-inf'", "a finite number"),
    "overflow": (GOOD + "1,1,1e999\n", "line 3: column qvel/slide: found '1e999'", "a finite number"),
    "decimal comma": (GOOD + "1,1,0,5\n", "line 3: found 4 cells", "3, as in the header"),
    "truncated": (GOOD + "1,1,2\n\n2,1", "line 5: found 2 cells", "3, as in the header"),
    "back in time": (GOOD + "1,1,2\n0.5,1,2\n", "line 4: column time: found 0.5 after 1.0", "increasing"),
    "same time": (GOOD + "0,1,2\n", "line 3: column time: found 0.0 after 0.0", "increasing"),
    "no time given": (GOOD + ",1,2\n", "line 3: column time: found nothing", "a number"),
    "nan time": (GOOD + "NaN,1,2\n", "line 3: column time: found 'NaN'", "a finite number, in every line"),
    "empty column": (
        "time,qpos/slide,qvel/slide\n0,1,\n1,2,\n",
        "column qvel/slide: found no value",
        "leave",
    ),
    "empty control": (
        "time,qpos/slide,ctrl/motor\n0,1,\n1,2,\n",
        "column ctrl/motor: found no value",
        "leave",
    ),
    "part of a quaternion": (
        "time,qpos/cube/qw\n0,1\n1,1\n",
        "without qpos/cube/qx",
        "qpos/cube/qw, qpos/cube/qx",
    ),
    "no quaternion": (
        f"time,{QUATERNION}\n0,1,0,0,0\n1,0.9,0,0,0\n",
        "line 3: columns qpos/cube/qw",
        "norm 0.9",
    ),
    "no whole quaternion": (f"time,{QUATERNION}\n0,1,,0,0\n1,,1,0,0\n", "none complete", "4 numbers"),
    "open quote": ('time,qpos/slide\n0,"1\n1,2\n', "cannot be read", "comma-separated"),
}


@pytest.mark.filterwarnings("ignore::det2stoc_bayes.recording.StudyWarning")
@pytest.mark.parametrize(("text", "found", "allowed"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_named(tmp_path: Path, text: str, found: str, allowed: str):
    with pytest.raises(StudyError) as caught:
        read(tmp_path / "recordings", text)
    message = str(caught.value)
    assert "\n" not in message and message.startswith("recordings/drop.csv: ")
    assert found in message and allowed in message and "allowed: " in message


@pytest.mark.parametrize(
    ("name", "content", "found", "allowed"),
    [
        ("drop.npz", b"", "cannot be read", "no pickle"),
        ("drop.pkl", b"", "'.pkl'", ".csv, .parquet, .npz"),
        ("drop", b"", "''", ".csv, .parquet, .npz"),
        ("drop.csv", b"time,qpos/slide\n0,\xff\n", "cannot be read", "UTF-8"),
        ("drop.parquet", b"PAR0", "cannot be read", "a Parquet file"),
        ("absent.csv", None, "no such file", ".csv"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, name: str, content: bytes | None, found: str, allowed: str):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(StudyError) as caught:
        read_recording(tmp_path / name, NAMES)
    message = str(caught.value)
    assert "\n" not in message and name in message and found in message and allowed in message


def test_a_folder_named_like_a_recording_is_refused(tmp_path: Path):
    (tmp_path / "x.csv").mkdir()
    with pytest.raises(StudyError, match=r"x\.csv: found a folder; allowed: "):
        read_recording(tmp_path / "x.csv", NAMES)


@pytest.mark.parametrize(
    ("column", "found"),
    [(["a", "b"], "found string values"), ([0.0, float("nan")], "row 2: column qpos/slide: found nan")],
)
def test_parquet_mistakes_are_named(tmp_path: Path, column: list, found: str):
    parquet.write_table(pa.table({"time": [0.0, 1.0], "qpos/slide": column}), tmp_path / "drop.parquet")
    with pytest.raises(StudyError, match=found):
        read_recording(tmp_path / "drop.parquet", NAMES)


TURN = np.linspace(0, 90, 11)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("time,qpos/slide,qvel/slide\n0,1,2\n1,1,3\n", "constant over the whole recording: qpos/slide"),
        (
            "time,qpos/elbow\n" + "".join(f"{i},{q}\n" for i, q in enumerate(TURN)),
            "looks like degrees: qpos/elbow",
        ),
    ],
)
def test_suspicions_are_told(tmp_path: Path, text: str, told: str):
    with pytest.warns(StudyWarning, match=told) as caught:
        read(tmp_path, text)
    assert len(caught) == 1 and "drop.csv" in str(caught[0].message)


@pytest.mark.parametrize(("speed", "suspect"), [(9.0, False), (9.0 * np.pi / 180, True)])
def test_degrees_are_told_by_the_recorded_speed(tmp_path: Path, speed: float, suspect: bool):
    names = ModelNames(("qpos/wheel", "qvel/wheel"), (), {}, {}, (), {"qpos/wheel": None})
    lines = "".join(f"{i},{q},{speed + 1e-6 * i}\n" for i, q in enumerate(TURN))
    (tmp_path / "drop.csv").write_text("time,qpos/wheel,qvel/wheel\n" + lines)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_recording(tmp_path / "drop.csv", names)
    assert bool(caught) is suspect


def test_a_wrapped_wheel_is_unwrapped_and_said_so(tmp_path: Path):
    true = np.linspace(0.0, 30.0, 60)
    rows = "".join(f"{i},{float((v + np.pi) % (2 * np.pi) - np.pi)!r}\n" for i, v in enumerate(true))
    with pytest.warns(StudyWarning, match="qpos/wheel: wrapped into one turn, and unwrapped at 5 jumps"):
        found = read(tmp_path, "time,qpos/wheel\n" + rows)
    np.testing.assert_allclose(found.values[:, 0], true, atol=1e-12)


def test_a_glitch_is_dropped_and_named_and_takes_its_orientation_along(tmp_path: Path):
    angle = 0.05 * np.arange(60)
    quaternion = np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle], 1)
    quaternion[30:] *= -1
    quaternion[40] = [0.6, 0.8, 0.0, 0.0]
    slide = np.sin(0.1 * np.arange(60))
    slide[20] += 1.0
    header = "time," + ",".join(CUBE[3:]) + ",qpos/slide,sensor/gyro/0\n"
    rows = np.column_stack([np.arange(60), quaternion, slide, slide])
    lines = [",".join(map(repr, map(float, row))) for row in rows]
    names = replace(NAMES, abrupt=("sensor/gyro/0",))
    (tmp_path / "b.csv").write_text(header + "\n".join(lines))
    with pytest.warns(StudyWarning) as told:
        found = read_recording(tmp_path / "b.csv", names)
    said = "\n".join(str(w.message) for w in told)
    assert "qpos/slide: a single sample out of line is treated as dropped: line 22" in said
    assert "qpos/cube/qw: a single sample out of line is treated as dropped: line 42" in said
    assert np.argwhere(np.isnan(found.values)).tolist() == [[20, 4], [40, 0], [40, 1], [40, 2], [40, 3]]


def test_a_glitch_in_an_orientation_is_dropped_and_noise_is_not(tmp_path: Path):
    """Components with a noise of 0.003 leave the unit sphere by 0.01 now and then."""
    rows = [[0.1 * k, 1.0, 0.0, 0.0, 0.0] for k in range(100)]
    rows[40][1], rows[60][1] = 0.97, 1.2
    text = f"time,{QUATERNION}\n" + "\n".join(",".join(map(repr, row)) for row in rows)
    with pytest.warns(StudyWarning, match="no unit quaternion, treated as dropped: line 62"):
        recording = read(tmp_path, text)
    assert np.flatnonzero(np.isnan(recording.values).any(axis=1)).tolist() == [60]
    np.testing.assert_allclose(np.linalg.norm(recording.values[40]), 1.0)
