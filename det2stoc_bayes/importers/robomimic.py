"""robomimic's HDF5 files: data/demo_0 ... with obs, actions and states; an observation comes before its action."""

import json
from pathlib import Path

import h5py

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import Asked, Contents, Log, Signal, SourceError
from det2stoc_bayes.importers.hdf5 import episodes, opened, signals

ABOUT = "robomimic's HDF5, a demonstration a recording; rows come at env_args' control_freq, or --period is asked for"
TAKES = ("period",)
SETTINGS: dict[str, str] = {}
TAKEN = ("obs", "actions", "states")


def read(source: Path, asked: Asked, names: ModelNames) -> Contents:
    """Signals `obs/<key>/0`, `states/0`, `actions/0` ... of every demonstration."""
    logs = []
    with opened(source) as file:
        data = file.get("data")
        if not isinstance(data, h5py.Group) or not episodes(data, "demo_"):
            raise SourceError(f"{source.name}: found {listing(file)}; allowed: groups data/demo_0 ... of robomimic")
        period, told = _period(data, asked, source.name)
        for name in episodes(data, "demo_"):
            if asked.wanted(name):
                where = f"{source.name}: {name}"
                logs.append(Log(name, where, _signals(data[name], period, where)))
    return Contents(logs, [f"{source.name}: a row every {period:g} s ({told})"], "after")


def _period(data: h5py.Group, asked: Asked, where: str) -> tuple[float, str]:
    """Seconds a row, and who said so."""
    if asked.period is not None:
        return asked.period, "given"
    try:
        told = json.loads(str(data.attrs.get("env_args", "{}")))
        rate = float(told.get("env_kwargs", {}).get("control_freq", 0))
    except (ValueError, TypeError, AttributeError) as error:
        raise SourceError(f"{where}: data's env_args: {error}; allowed: JSON of robomimic, or --period") from error
    return (1 / rate, f"env_args: control_freq {rate:g} Hz") if rate > 0 else (asked.step(where), "given")


def _signals(demo: object, period: float, where: str) -> dict[str, Signal]:
    if not isinstance(demo, h5py.Group) or not set(TAKEN) & set(demo):
        found = listing(demo) if isinstance(demo, h5py.Group) else "no group"
        raise SourceError(f"{where}: found {found}; allowed: some of {listing(TAKEN)}")
    return {k: s for part in TAKEN if part in demo for k, s in signals(demo[part], part, period, where)}
