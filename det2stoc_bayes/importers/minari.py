"""Minari data sets (Farama): main_data.hdf5, a group an episode. Observation t is followed by action t."""

from pathlib import Path

import h5py

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import Asked, Contents, Log, Signal, SourceError
from det2stoc_bayes.importers.hdf5 import Clock, episodes, evenly, height, opened, signals

ABOUT = "a Minari data set's folder, or its main_data.hdf5, an episode a recording; --period is asked for"
TAKES = ("period",)
SETTINGS: dict[str, str] = {}
TAKEN = ("observations", "actions", "infos")


def read(source: Path, asked: Asked, names: ModelNames) -> Contents:
    """Signals `observations/0`, `infos/qpos/0`, `actions/0` ... of every episode."""
    within = [source / "data" / "main_data.hdf5", source / "main_data.hdf5"]
    path = next((p for p in within if p.is_file()), within[0]) if source.is_dir() else source
    logs = []
    with opened(path) as file:
        found = episodes(file, "episode_")
        if not found:
            raise SourceError(f"{path.name}: found {listing(file)}; allowed: groups episode_0, episode_1 ... of Minari")
        period = asked.step(path.name)
        for name in found:
            if asked.wanted(name):
                logs.append(Log(name, f"{path.name}: {name}", _signals(file[name], period, f"{path.name}: {name}")))
    return Contents(logs, [f"{path.name}: a row every {period:g} s (given)"], "after")


def _signals(episode: object, period: float, where: str) -> dict[str, Signal]:
    if not isinstance(episode, h5py.Group) or not {"observations", "actions"} <= set(episode):
        found = listing(episode) if isinstance(episode, h5py.Group) else "no group"
        raise SourceError(f"{where}: found {found}; allowed: observations and actions")
    steps, seen = height(episode["actions"]), height(episode["observations"])
    if seen != steps + 1:
        raise SourceError(f"{where}: found {seen} observations and {steps} actions; allowed: one observation more")
    every: dict[str, Signal] = {}
    for part in (part for part in TAKEN if part in episode):
        every.update(signals(episode[part], part, _after(period, steps) if part == "infos" else evenly(period), where))
    return every


def _after(period: float, steps: int) -> Clock:
    """Of as many rows as actions each is of the observation after its action."""
    return lambda rows: evenly(period, int(rows == steps))(rows)
