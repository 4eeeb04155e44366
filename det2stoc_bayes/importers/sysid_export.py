"""A study's recordings for mujoco.sysid: a SystemTrajectory of controls, measurements and the initial state each."""

import io
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.engines.full_state import full_state
from det2stoc_bayes.engines.model_names import ModelNames, compile_model
from det2stoc_bayes.errors import listing
from det2stoc_bayes.files import atomic_write, check_folder
from det2stoc_bayes.importers.base import SourceError
from det2stoc_bayes.recording import Recording, StudyWarning
from det2stoc_bayes.recording_npz import KINDS, signal_columns
from det2stoc_bayes.study import Study

if TYPE_CHECKING:
    import mujoco

Signal = tuple[int, tuple[str, ...]]  # mujoco.sysid's SignalType, and the columns that a signal consists of


def export_sysid(study: Study, out: Path) -> list[Path]:
    """Write `<recording>.npz` of every recording, held-out ones too; they load by SystemTrajectory.load_from_disk.

    mujoco.sysid makes one step a control, so controls are held on the model's steps. It knows no dropped samples:
    rows with an empty cell are left out. SourceError: a recording with none left.
    """
    model, out = compile_model(study.model_path, study.folder), Path(out)
    every = (*study.recordings, *study.holdout)
    check_folder(out, *(f"{r.name}.npz" for r in every))
    signals = _signals(study.names)
    files = {}
    for recording in every:
        there = {name: signal for name, signal in signals.items() if set(signal[1]) <= set(recording.columns)}
        taken = [column for _, columns in there.values() for column in columns]
        _tell_left_out(recording, taken)
        values = recording.values[:, [recording.columns.index(c) for c in taken]]
        whole = ~np.isnan(values).any(axis=1)
        if whole.sum() < 2:
            raise SourceError(
                f"{recording.name}: {whole.sum()} rows have every one of {listing(taken)}; allowed: 2 or more"
            )
        if not whole.all():
            _tell(f"{recording.name}: {(~whole).sum()} rows with a dropped sample are left out")
        files[out / f"{recording.name}.npz"] = _file(model, recording, there, values[whole], whole)
    for path, content in files.items():
        atomic_write(path, content)
    return list(files)


def _file(
    model: "mujoco.MjModel",
    recording: Recording,
    signals: Mapping[str, Signal],
    values: Float[np.ndarray, "rows columns"],
    whole: Bool[np.ndarray, " samples"],
) -> bytes:
    """One recording: `values` are the columns of `signals` in turn, in the rows that are `whole`."""
    time = recording.time[whole]
    steps = round(float(time[-1] - time[0]) / model.opt.timestep)
    fine = time[0] + model.opt.timestep * np.arange(steps + 1)
    held = np.searchsorted(recording.time, fine + 1e-9 * model.opt.timestep, side="right") - 1
    taken = [column for _, columns in signals.values() for column in columns]
    state, missing = full_state(model, float(time[0]), dict(zip(taken, values[0].tolist(), strict=True)))
    if missing:
        _tell(f"{recording.name}: {listing(missing)} not recorded; the initial state has the model's own")
    mapping, first = {}, 0
    for name, (kind, columns) in signals.items():
        mapping[name] = [kind, list(range(first, first + len(columns)))]
        first += len(columns)
    controls = {f"{model.actuator(i).name}_ctrl": [5, [i]] for i in range(recording.ctrl.shape[1])}
    arrays = {
        "control_times": fine, "control_data": recording.ctrl[held], "sensordata_times": time,
        "sensordata_data": values, "initial_state": state, "sensordata_signal_mapping": np.asarray(json.dumps(mapping)),
    }  # fmt: skip
    if controls:
        arrays["control_signal_mapping"] = np.asarray(json.dumps(controls))
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _signals(names: ModelNames) -> dict[str, Signal]:
    """mujoco.sysid's name of every signal -> its SignalType and the columns that it consists of."""
    bodies = {joint: body for body, joint in names.free_bodies.items() if body}
    found: dict[str, Signal] = {}
    for kind, (start, ending) in KINDS.items():
        for element, columns in signal_columns(start, names).items():
            free = len(columns) in (6, 7) and start != "sensor"
            found[(bodies.get(element, element) if free else element) + ending] = (kind, columns)
    return found


def _tell_left_out(recording: Recording, taken: list[str]) -> None:
    left = [column for column in recording.columns if column not in taken]
    if left:
        _tell(f"{recording.name}: {listing(left)} left out: a signal of mujoco.sysid has all of its components")


def _tell(message: str) -> None:
    warnings.warn(message, StudyWarning, stacklevel=4)
