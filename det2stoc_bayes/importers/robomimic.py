"""robomimic's HDF5 files: data/demo_0 ... with obs, actions and states; an observation comes before its action."""

import json
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import Asked, Contents, Log, Signal, SourceError, clock
from det2stoc_bayes.importers.hdf5 import Clock, episodes, evenly, opened, signals

ABOUT = ("robomimic's HDF5, a demonstration a recording; rows come at the times in robosuite's states, or at env_args' "
         "control_freq, or --period is asked for")  # fmt: skip
TAKES = ("period",)
SETTINGS: dict[str, str] = {}
TAKEN = ("obs", "actions", "states")
ROBOSUITE = 1  # robomimic's EnvType of the simulator whose states begin with the time


def read(source: Path, asked: Asked, names: ModelNames) -> Contents:
    """Signals `obs/<key>/0`, `states/0`, `actions/0` ... of every demonstration."""
    logs, notes = [], {}
    with opened(source) as file:
        data = file.get("data")
        if not isinstance(data, h5py.Group) or not episodes(data, "demo_"):
            raise SourceError(f"{source.name}: found {listing(file)}; allowed: groups data/demo_0 ... of robomimic")
        env = _environment(data, source.name) if asked.period is None else (False, 0.0)
        for name in episodes(data, "demo_"):
            if asked.wanted(name):
                where = f"{source.name}: {name}"
                times, told = _clock(data[name], env, asked, where)
                logs.append(Log(name, where, _signals(data[name], times, where)))
                notes[f"{source.name}: {told}"] = None
    return Contents(logs, list(notes), "after")


def _environment(data: h5py.Group, where: str) -> tuple[bool, float]:
    """Whether robosuite was recorded, and at which rate [Hz]: 0 where the file does not say it."""
    try:
        told = json.loads(str(data.attrs.get("env_args", "{}")))
        return told.get("type") == ROBOSUITE, float((told.get("env_kwargs") or {}).get("control_freq") or 0)
    except (ValueError, TypeError, AttributeError) as error:
        raise SourceError(f"{where}: data's env_args: {error}; allowed: JSON of robomimic, or --period") from error


def _clock(demo: object, env: tuple[bool, float], asked: Asked, where: str) -> tuple[Clock, str]:
    """The times of a demonstration's rows, and who said so.

    robosuite makes whole steps, so its rows may come more often than control_freq says: the time in its states is true.
    """
    robosuite, rate = env
    states = demo.get("states") if isinstance(demo, h5py.Group) else None
    if robosuite and isinstance(states, h5py.Dataset) and states.ndim == 2 and states.shape[1]:
        try:
            time = clock(states[:, 0], f"{where}: states/0, the time")
        except SourceError as error:
            raise SourceError(f"{error}, or --period") from error
        return _as_recorded(time, where), "rows at the times in states, as robosuite wrote them"
    if rate > 0:
        return evenly(1 / rate), f"a row every {1 / rate:g} s (env_args: control_freq {rate:g} Hz)"
    period = asked.step(where)
    return evenly(period), f"a row every {period:g} s (given)"


def _as_recorded(time: Float[np.ndarray, " samples"], where: str) -> Clock:
    """These times, of arrays that have as many rows."""

    def times(rows: int) -> Float[np.ndarray, " samples"]:
        if rows != len(time):
            raise SourceError(f"{where}: found {rows} rows beside {len(time)} states; allowed: as many, or --period")
        return time

    return times


def _signals(demo: object, times: Clock, where: str) -> dict[str, Signal]:
    if not isinstance(demo, h5py.Group) or not set(TAKEN) & set(demo):
        found = listing(demo) if isinstance(demo, h5py.Group) else "no group"
        raise SourceError(f"{where}: found {found}; allowed: some of {listing(TAKEN)}")
    return {k: s for part in TAKEN if part in demo for k, s in signals(demo[part], part, times, where)}
