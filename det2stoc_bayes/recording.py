"""One recorded trajectory, read from a file and checked against the model's names."""

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import StudyError, listing
from det2stoc_bayes.recording_angles import unwrap
from det2stoc_bayes.recording_files import Table, read_csv, read_parquet
from det2stoc_bayes.recording_glitches import glitches
from det2stoc_bayes.recording_npz import read_npz
from det2stoc_bayes.suggestions import choices

MOST_NORM_ERROR = 0.05  # of a quaternion: noise is normalised away, more is a glitch or a mistake
GLITCH_NORMS = (0.5, 2.0)  # between which single samples are glitches
MOST_GLITCHES = 0.02  # of the samples
LARGEST = 1e12  # of a number, in SI units
LARGEST_COMMAND = 1e10  # MuJoCo takes a larger one for a broken simulation
MOST_BYTES = 1_000_000_000  # of a file: its numbers are held in memory at once
BEYOND = 0.05  # of a joint's range: what soft limits and noise may exceed it by
LEAST_SUSPECT_SPAN = 50.0  # rad, eight turns: more may be degrees
DEGREES = math.degrees(1.0)


class StudyWarning(UserWarning):
    """Something in a study's files is allowed but looks like a mistake."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One trajectory: `values` holds the measured `columns`, NaN where a sample was dropped.

    `ctrl` has one column per control of the model, in its order, 0 where the file has none; an empty cell
    holds the value before it. The arrays are read-only.
    """

    name: str
    time: Float[np.ndarray, " samples"]
    columns: tuple[str, ...]
    values: Float[np.ndarray, "samples columns"]
    ctrl: Float[np.ndarray, "samples actuators"]
    path: Path
    commanded: tuple[str, ...] = ()  # the controls that the file has, `ctrl/<actuator>`


def read_recording(path: Path, names: ModelNames) -> Recording:
    """The recording in a .csv, .parquet or mujoco.sysid .npz file; a StudyError names line and column."""
    label = f"{path.parent.name}/{path.name}"
    readers = {".csv": read_csv, ".parquet": read_parquet, ".npz": partial(read_npz, names=names)}
    if path.is_dir():
        raise StudyError(f"{label}: found a folder; allowed: a .csv, .parquet or .npz file")
    if path.suffix.lower() not in readers:
        raise StudyError(f"{label}: cannot read a '{path.suffix}' file; allowed: {listing(readers)}")
    if not path.is_file():
        raise StudyError(f"{label}: no such file; allowed: a .csv, .parquet or .npz file")
    if path.stat().st_size > MOST_BYTES:
        raise StudyError(f"{label}: found {path.stat().st_size / 1e9:.1f} GB; allowed: at most {MOST_BYTES / 1e9:g} GB")
    table = readers[path.suffix.lower()](path, label, partial(_check_header, names))
    if len(table.cells) < 2:
        found = "no sample" if len(table.cells) == 0 else "a single sample"
        raise StudyError(f"{label}: found {found} below the header; allowed: at least 2")
    time = _checked_time(table)
    for column in table.header:
        if np.isnan(table.column(column)).all():
            raise table.fail(f"column {column}: found no value at all; allowed: numbers (leave the column out)")
        largest = LARGEST_COMMAND if column.startswith("ctrl/") else LARGEST
        huge = np.flatnonzero(np.abs(table.column(column)) > largest) if column != "time" else []
        if len(huge):
            value = float(table.column(column)[huge[0]])
            raise table.fail(f"column {column}: found {value!r}; allowed: at most {largest:g} in size", int(huge[0]))
    columns = tuple(c for c in table.header if c in names.columns)
    values = np.stack([table.column(c) for c in columns], axis=1)
    _unwrap(label, columns, values, names)
    _normalise_quaternions(table, columns, values, names)
    _drop_glitches(table, time, columns, values, names)
    _warn(label, time, columns, values, names)
    ctrl = _controls(table, names)
    for data in (time, values, ctrl):
        data.setflags(write=False)
    commanded = tuple(c for c in table.header if c.startswith("ctrl/"))
    return Recording(path.stem, time, columns, values, ctrl, path, commanded)


def _check_header(names: ModelNames, label: str, header: tuple[str, ...]) -> None:
    known = [*names.columns, *(f"ctrl/{name}" for name in names.actuators if name)]
    if "time" not in header:
        hint = " (cells are separated by commas)" if len(header) == 1 else ""
        raise StudyError(f"{label}: no column 'time'; found {listing(header)}{hint}; allowed: time, {listing(known)}")
    for column in header:
        if column not in known and column != "time":
            raise StudyError(f"{label}: unknown column '{column}'; {choices(column, ['time', *known], limit=20)}")
    if not set(header) & set(names.columns):
        raise StudyError(f"{label}: no measured column; found {listing(header)}; allowed: {listing(names.columns, 20)}")
    for parts in names.quaternions:
        missing = [part for part in parts if part not in header]
        if 0 < len(missing) < 4:
            raise StudyError(f"{label}: incomplete quaternion, without {listing(missing)}; allowed: {listing(parts)}")


def _checked_time(table: Table) -> Float[np.ndarray, " samples"]:
    time = table.column("time").copy()
    empty = np.flatnonzero(np.isnan(time))
    if len(empty):
        raise table.fail("column time: found nothing; allowed: a number in every line", int(empty[0]))
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        before, after = float(time[back[0]]), float(time[back[0] + 1])
        raise table.fail(f"column time: found {after!r} after {before!r}; allowed: only increasing", int(back[0]) + 1)
    return time


def _unwrap(
    label: str, columns: tuple[str, ...], values: Float[np.ndarray, "samples columns"], names: ModelNames
) -> None:
    """Undo in place what a recorder did to unlimited hinges that turn on."""
    for j, column in enumerate(columns):
        if column in names.hinges and names.hinges[column] is None:
            values[:, j], jumps = unwrap(values[:, j])
            if jumps:
                _tell(f"{label}: {column}: wrapped into one turn, and unwrapped at {jumps} jumps of 2 pi")


def _drop_glitches(
    table: Table,
    time: Float[np.ndarray, " samples"],
    columns: tuple[str, ...],
    values: Float[np.ndarray, "samples columns"],
    names: ModelNames,
) -> None:
    """Empty, in place, single samples that stand alone; an orientation goes as a whole."""
    groups = {c: group for group in names.quaternions for c in group if group[0] in columns}
    smooth = _of_one_sign(columns, values, names)
    found = {c: glitches(time, smooth[:, j]) for j, c in enumerate(columns) if c not in names.abrupt}
    for column, alone in found.items():
        if alone.any():
            rows = np.flatnonzero(alone)
            shown = listing((str(table.lines[int(i)]) for i in rows), 5)
            many = "a single sample out of line is" if len(rows) == 1 else f"{len(rows)} samples out of line are"
            _tell(f"{table.label}: {column}: {many} treated as dropped: {table.unit} {shown}")
            for c in groups.get(column, (column,)):
                values[rows, columns.index(c)] = np.nan


def _normalise_quaternions(
    table: Table, columns: tuple[str, ...], values: Float[np.ndarray, "samples columns"], names: ModelNames
) -> None:
    """Make every quaternion a unit one, and drop those with an empty component, in place."""
    for group in names.quaternions:
        if group[0] not in columns:
            continue
        parts, shown = [columns.index(c) for c in group], f"{group[0]} to /{group[-1].rpartition('/')[2]}"
        norm = np.sqrt((values[:, parts] ** 2).sum(axis=1))
        wrong = np.flatnonzero(np.abs(norm - 1) > MOST_NORM_ERROR)
        odd = [i for i in wrong if GLITCH_NORMS[0] < norm[i] < GLITCH_NORMS[1]]
        if 0 < len(odd) == len(wrong) <= MOST_GLITCHES * len(norm):
            lines = listing((str(table.lines[int(i)]) for i in wrong), 5)
            _tell(f"{table.label}: {shown}: no unit quaternion, treated as dropped: {table.unit} {lines}")
            values[np.ix_(wrong, parts)], norm[wrong] = np.nan, np.nan
        elif len(wrong):
            raise table.fail(
                f"columns {shown}: found a quaternion of norm {norm[wrong[0]]:.6g}; allowed: 1 "
                f"within {MOST_NORM_ERROR:g}",
                int(wrong[0]),
            )
        partly: Bool[np.ndarray, " samples"] = np.isnan(norm) & ~np.isnan(values[:, parts]).all(axis=1)
        if partly.any():
            _tell(f"{table.label}: {shown}: {partly.sum()} quaternions with an empty component are dropped")
        values[:, parts] /= norm[:, None]
        if np.isnan(norm).all():
            raise table.fail(f"columns {shown}: none complete; allowed: 4 numbers")


def _of_one_sign(
    columns: tuple[str, ...], values: Float[np.ndarray, "samples columns"], names: ModelNames
) -> Float[np.ndarray, "samples columns"]:
    """The values with each quaternion of the sign that is nearer to the one before it."""
    out = values.copy()
    for group in names.quaternions:
        if group[0] in columns:
            parts = [columns.index(c) for c in group]
            seen = np.flatnonzero(~np.isnan(values[:, parts[0]]))
            turned = (values[seen[1:, None], parts] * values[seen[:-1, None], parts]).sum(axis=1) < 0
            out[seen[1:, None], parts] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    return out


def _controls(table: Table, names: ModelNames) -> Float[np.ndarray, "samples actuators"]:
    """The held controls; before its first value a control is that value, as it is before the recording."""
    ctrl = np.zeros((len(table.cells), len(names.actuators)))
    for j, name in enumerate(names.actuators):
        if name and f"ctrl/{name}" in table.header:
            given = table.column(f"ctrl/{name}")
            present = np.flatnonzero(~np.isnan(given))
            latest = np.searchsorted(present, np.arange(len(given)), side="right") - 1
            ctrl[:, j] = given[present[np.maximum(latest, 0)]]
    return ctrl


def _tell(message: str) -> None:
    warnings.warn(message, StudyWarning, stacklevel=4)


def _warn(
    label: str,
    time: Float[np.ndarray, " samples"],
    columns: tuple[str, ...],
    values: Float[np.ndarray, "samples columns"],
    names: ModelNames,
) -> None:
    """Tell what is allowed but suspicious."""
    present = (~np.isnan(values)).sum(axis=0)
    same = [c for c, v, n in zip(columns, values.T, present, strict=True) if n > 1 and np.nanmin(v) == np.nanmax(v)]
    if same:
        _tell(f"{label}: constant over the whole recording: {listing(same)}")
    degrees = list(_in_degrees(time, columns, values, names))
    if degrees:
        _tell(f"{label}: looks like degrees: {listing(degrees)}; angles are in rad")
    for column, limits in names.hinges.items():
        if limits is None or column not in columns or column in degrees:
            continue
        position, slack = values[:, columns.index(column)], BEYOND * (limits[1] - limits[0])
        low, high = float(np.nanmin(position)), float(np.nanmax(position))
        if low < limits[0] - slack or high > limits[1] + slack:
            shown = (
                f"goes from {low:.4g} to {high:.4g} rad, and the joint's range is {limits[0]:.4g} to {limits[1]:.4g}"
            )
            _tell(f"{label}: {column} {shown} (degrees?)")


def _in_degrees(
    time: Float[np.ndarray, " samples"],
    columns: tuple[str, ...],
    values: Float[np.ndarray, "samples columns"],
    names: ModelNames,
) -> Iterator[str]:
    """Hinge positions that turn far while the joint's range, or the recorded speed, is 57 times smaller."""
    for column in set(columns) & set(names.hinges):
        position = values[:, columns.index(column)]
        span = np.nanmax(position) - np.nanmin(position)
        if span <= LEAST_SUSPECT_SPAN:
            continue
        limits, speed = names.hinges[column], column.replace("qpos/", "qvel/", 1)
        if limits is not None and span > DEGREES / 4 * (limits[1] - limits[0]):
            yield column
        elif speed in columns:
            recorded = np.nanmedian(np.abs(values[:, columns.index(speed)]))
            moved = np.abs(np.diff(position) / np.diff(time))
            moved = moved[np.isfinite(moved)]
            if len(moved) and abs(math.log(max(np.median(moved), 1e-300) / max(recorded, 1e-300) / DEGREES)) < 0.4:
                yield column
