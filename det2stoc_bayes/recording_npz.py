"""Files of mujoco.sysid (.npz): a TimeSeries, or a SystemTrajectory of controls and sensors. No pickle is read."""

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import StudyError, listing
from det2stoc_bayes.recording_files import Header, Table

# mujoco.sysid's SignalType -> what a column begins with, and how its own names end; activations (4) are no column.
KINDS = {0: ("sensor", ""), 2: ("qpos", "_qpos"), 3: ("qvel", "_qvel"), 5: ("ctrl", "_ctrl")}
SERIES, TRAJECTORY = ("times", "data"), ("control_times", "control_data", "sensordata_times", "sensordata_data")
LAYOUTS = f"{listing(SERIES)} (a TimeSeries), or {listing(TRAJECTORY)} (a SystemTrajectory)"
_PLACE, _TURN = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
_PARTS = {  # of qpos and qvel, by how many numbers a joint has
    ("qpos", 7): (*_PLACE, *_TURN),
    ("qpos", 4): _TURN,
    ("qvel", 6): ("vx", "vy", "vz", "wx", "wy", "wz"),
    ("qvel", 3): ("wx", "wy", "wz"),
}
_EVERY_PART = {part for parts in _PARTS.values() for part in parts}


@dataclass(frozen=True, eq=False)
class Series:
    """Columns on one clock. `simulated`: the file says that mujoco.sysid simulated it, and its times are mended."""

    columns: tuple[str, ...]
    time: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, "samples columns"]
    simulated: bool = False


def read_series(path: Path, label: str, names: ModelNames) -> list[Series]:
    """What a file of mujoco.sysid holds, with its signals named as a study's columns.

    A SystemTrajectory with states was simulated: mujoco.sysid stamps its sensors with the end of the step at whose
    beginning they are computed, one step late; they get the right times here. StudyError: another file, or layout.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError, AttributeError) as error:
        reason = " ".join(str(error).split()) if zipfile.is_zipfile(path) else "no zip archive, as a .npz is"
        raise StudyError(f"{label}: cannot be read: {reason}; allowed: a .npz of mujoco.sysid, no pickle") from error
    if set(SERIES) <= set(arrays):
        return [_series(arrays, "", label, names)]
    if not set(TRAJECTORY) <= set(arrays):
        raise StudyError(f"{label}: found arrays {listing(arrays)}; allowed: {LAYOUTS}")
    simulated = {"state_times", "state_data", "initial_state"} <= set(arrays)
    if simulated:
        ended = arrays["state_times"]
        if arrays["sensordata_times"].shape == ended.shape and (arrays["sensordata_times"] == ended).all():
            arrays["sensordata_times"] = np.concatenate([arrays["initial_state"][:1], ended[:-1]])
        if arrays["state_data"].ndim == 2 and (arrays["state_data"][:, 0] == ended).all():
            arrays["state_data"] = arrays["state_data"][:, 1:]  # the mapping counts without the time
    parts = ("control_", "sensordata_", *(["state_"] if simulated else []))
    found = [_series(arrays, part, label, names, simulated) for part in parts if arrays[f"{part}data"].size]
    return [series for series in found if series.columns]


def read_npz(path: Path, label: str, check: Header, names: ModelNames) -> Table:
    """A file of mujoco.sysid as a table; where its clocks differ, rows of both, with empty cells."""
    found = read_series(path, label, names)
    header = ("time", *(column for series in found for column in series.columns))
    twice = sorted({name for name in header if header.count(name) > 1})
    if twice:
        raise StudyError(f"{label}: found signal '{twice[0]}' {header.count(twice[0])} times; allowed: each once")
    check(label, header)
    time, values = merged([(series.time, series.values) for series in found])
    return Table(label, header, np.column_stack([time, values]), range(1, len(time) + 1), "row")


def merged(
    parts: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples columns"]]:
    """Several (time, values) on one clock: the times of all to a nanosecond, and NaN where a part has no sample."""
    parts = [(np.round(t, 9), v) for t, v in parts]
    time = np.unique(np.concatenate([t for t, _ in parts])) if parts else np.zeros(0)
    values = np.full((len(time), sum(v.shape[1] for _, v in parts)), np.nan)
    first = 0
    for t, v in parts:
        values[np.searchsorted(time, t), first : first + v.shape[1]] = v
        first += v.shape[1]
    return time, values


def _series(
    arrays: Mapping[str, np.ndarray], part: str, label: str, names: ModelNames, simulated: bool = False
) -> Series:
    """One of a file's time series, its columns in the order of its signals."""
    time, data, where = arrays[f"{part}times"], arrays[f"{part}data"], f"{label}: {part}data"
    if not (np.issubdtype(time.dtype, np.number) and np.issubdtype(data.dtype, np.number)):
        raise StudyError(f"{where}: found {data.dtype} and {time.dtype} times; allowed: numbers")
    if data.ndim != 2 or time.shape != data.shape[:1]:
        raise StudyError(f"{where}: found {data.shape} numbers at {time.shape} times; allowed: a row of numbers a time")
    time, data = np.asarray(time, float), np.asarray(data, float)
    for array, name in ((time, "times"), (data, "data")):
        if not np.isfinite(array).all():
            raise StudyError(f"{label}: {part}{name}: found what is no finite number; allowed: finite numbers")
    if (np.diff(time) <= 0).any():
        row = int(np.flatnonzero(np.diff(time) <= 0)[0]) + 1
        raise StudyError(f"{label}: {part}times: row {row + 1}: found {time[row]:g} after {time[row - 1]:g}; allowed: "
                         "only increasing")  # fmt: skip
    columns, places = [], []
    for name, kind, indices in _mapping(arrays, part, label):
        for column, place in zip(_columns(name, kind, len(indices), names, where), indices, strict=True):
            if not 0 <= place < data.shape[1]:
                raise StudyError(f"{where}: signal '{name}' is column {place} of {data.shape[1]}; allowed: one it has")
            columns.append(column)
            places.append(place)
    return Series(tuple(columns), time, data[:, places], simulated)


def _mapping(arrays: Mapping[str, np.ndarray], part: str, label: str) -> Iterator[tuple[str, int, list[int]]]:
    """Name, SignalType and data columns of the signals that a study can have."""
    key = f"{part}signal_mapping"
    allowed = 'the JSON of mujoco.sysid, as {"wrist_qpos": [2, [0]]}'
    if key not in arrays:
        raise StudyError(f"{label}: no {key}: which signals are its columns? allowed: {allowed}")
    try:
        told: dict[str, Any] = json.loads(str(arrays[key]))
        signals = [(str(name), int(kind), [int(i) for i in indices]) for name, (kind, indices) in told.items()]
    except (ValueError, TypeError, AttributeError) as error:
        raise StudyError(f"{label}: {key}: found {str(arrays[key])[:60]!r}; allowed: {allowed}") from error
    for name, kind, indices in signals:
        if kind == 1:
            raise StudyError(f"{label}: {key}: '{name}' is a CustomObs; allowed: sensors, qpos, qvel, controls")
        if kind in KINDS and name not in ("None_ctrl", "_ctrl"):
            yield name, kind, indices


def _columns(name: str, kind: int, width: int, names: ModelNames, where: str) -> list[str]:
    """The columns of one signal; mujoco.sysid calls a free joint by its body's name."""
    start, ending = KINDS[kind]
    name = name.removesuffix(ending) if ending else name
    if start in ("qpos", "qvel") and width >= 6:
        name = names.free_bodies.get(name, name)
    if width == 1:
        return [f"{start}/{name}"]
    if start == "sensor":
        return [f"sensor/{name}/{i}" for i in range(width)]
    if (start, width) not in _PARTS:
        raise StudyError(f"{where}: signal '{name}' has {width} numbers; allowed: those of a joint")
    return [f"{start}/{name}/{part}" for part in _PARTS[start, width]]


def signal_columns(start: str, names: ModelNames) -> dict[str, tuple[str, ...]]:
    """Element -> the columns of one kind (qpos, qvel, sensor; none of ctrl) that are one signal of it."""
    found: dict[str, tuple[str, ...]] = {}
    for column in names.columns if start != "ctrl" else ():
        kind, _, rest = column.partition("/")
        element, _, part = rest.rpartition("/")
        parted = element and (part.isdigit() if kind == "sensor" else part in _EVERY_PART)
        if kind == start:
            element = element if parted else rest
            found[element] = (*found.get(element, ()), column)
    return found
