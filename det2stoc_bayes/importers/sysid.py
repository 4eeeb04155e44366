"""Files of mujoco.sysid (.npz): TimeSeries and SystemTrajectory, a file a recording."""

from pathlib import Path

import numpy as np

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.importers.base import MODEL_UNITS, Asked, Contents, Log, Signal, SourceError, files
from det2stoc_bayes.recording_npz import Series, read_series

ABOUT = "mujoco.sysid's .npz (TimeSeries or SystemTrajectory), a file a recording; names and units are the model's"
TAKES: tuple[str, ...] = ()
SETTINGS = {"stamps": "of a TimeSeries with sensors: measured, or rollout (sensors stamped one step late)"}
STAMPS = ("measured", "rollout")


def read(source: Path, asked: Asked, names: ModelNames) -> Contents:
    """Every file as a log; sensors that mujoco.sysid simulated are moved to the step that they belong to."""
    logs, notes = [], []
    for path in files(source, ".npz"):
        if not asked.wanted(path.stem):
            continue
        found = read_series(path, path.name, names)
        if any(series.simulated for series in found):
            notes.append(f"{path.name} was simulated by mujoco.sysid; its sensors, stamped one step late, were moved")
        signals: dict[str, Signal] = {}
        for series in found:
            time = _times(series, asked, path.name)
            for column, values in zip(series.columns, series.values.T, strict=True):
                if column in signals:
                    raise SourceError(f"{path.name}: found signal '{column}' twice; allowed: each once")
                signals[column] = Signal(time, values, MODEL_UNITS, column)
        logs.append(Log(path.stem, path.name, signals))
    return Contents(logs, notes, "after")


def _times(series: Series, asked: Asked, where: str) -> np.ndarray:
    """A lone TimeSeries does not say whether a rollout stamped its sensors."""
    sensors = any(column.startswith("sensor/") for column in series.columns)
    if series.simulated or not sensors or len(series.time) < 2:
        return series.time
    if asked.setting("stamps", STAMPS, f"{where}: how sensors are stamped") == "measured":
        return series.time
    return np.concatenate([series.time[:1] - (series.time[1] - series.time[0]), series.time[:-1]])
