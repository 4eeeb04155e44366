"""What a format gives and what it may ask: the contract that one module a format fulfils."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import Det2StocError, listing
from det2stoc_bayes.suggestions import choices

Phase = Literal["after", "before", "centred"]
PHASES = {
    "after": "a control acts from its row's time to the next row's",
    "before": "a control acted from the row before up to its row's time",
    "centred": "a control acts half a row before and half a row after its row's time",
}
CLOCKS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
MODEL_UNITS = "model"  # the number is as the model has it: SI, and for a control whatever its actuator takes


class SourceError(Det2StocError):
    """Something in the files that are imported, or in what was said about them, is wrong."""


@dataclass(frozen=True, eq=False)
class Signal:
    """One channel of a log on its own clock [s], NaN where a sample was dropped.

    `unit`: None where neither file nor format says it. `column`: the column whose very name it bears, if any.
    """

    time: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, " samples"]
    unit: str | None = None
    column: str | None = None


@dataclass(frozen=True, eq=False)
class Log:
    """One recorded trajectory: `name` becomes its file's stem, `origin` is where it came from, for messages."""

    name: str
    origin: str
    signals: Mapping[str, Signal]


@dataclass(frozen=True, eq=False)
class Contents:
    """All that a source holds; `phase` where the format itself says when controls act; `notes` for SOURCE.md."""

    logs: Sequence[Log]
    notes: Sequence[str] = ()
    phase: Phase | None = None


@dataclass(frozen=True)
class Mapped:
    """How a column comes from a signal of `unit`: `scale` times its value in the column's unit, plus `offset` in it."""

    signal: str
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Asked:
    """What the user said of a source, by options or a mapping file.

    `units`: pattern of columns -> unit. `delays` [s]: column -> by how much it is older than its stamp. `settings`: a
    format's own options. `only` and `holdout` are patterns of recordings' names.
    """

    columns: Mapping[str, Mapped] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    delays: Mapping[str, float] = field(default_factory=dict)
    clock: str | None = None
    period: float | None = None
    phase: Phase | None = None
    settings: Mapping[str, str] = field(default_factory=dict)
    only: str = "*"
    holdout: str | None = None

    def setting(self, name: str, allowed: Sequence[str], why: str, default: str | None = None) -> str:
        """A format's own option; SourceError where it is missing without a default, or not allowed."""
        found = self.settings.get(name, default)
        if found is None:
            raise SourceError(f"{why}: the file does not say it; give --set {name}=...; allowed: {listing(allowed)}")
        if allowed and found not in allowed:
            raise SourceError(f"--set {name}: found '{found}'; {choices(found, allowed)}")
        return found

    def seconds(self, where: str, given: str | None = None) -> float:
        """Seconds in a unit of the clock: the one that the file gives, or else that of --clock."""
        unit = self.clock or given
        if unit is None:
            raise SourceError(f"{where}: the file does not say the unit of its time; give --clock; "
                              f"allowed: {listing(CLOCKS)}")  # fmt: skip
        if unit not in CLOCKS:
            raise SourceError(f"--clock: found '{unit}'; {choices(unit, CLOCKS)}")
        return CLOCKS[unit]

    def step(self, where: str) -> float:
        """The time between two samples of a file that has no times."""
        if self.period is None:
            raise SourceError(f"{where}: the file has no times; give --period; allowed: seconds from row to row")
        return self.period

    def wanted(self, name: str) -> bool:
        """Whether a recording of this name is to be read."""
        return fnmatchcase(name, self.only)


class Format(Protocol):
    """A module of this package: what is read, which of clock and period it takes, what it may ask by --set, and how."""

    ABOUT: str
    TAKES: Sequence[str]
    SETTINGS: Mapping[str, str]
    read: Callable[[Path, Asked, ModelNames], Contents]


def numbers(values: object, where: str) -> Float[np.ndarray, "*shape"]:
    """An array of floats, NaN for what is missing; SourceError for text and infinity."""
    try:
        array = np.asarray(values, float)
    except (ValueError, TypeError) as error:
        raise SourceError(f"{where}: found what is no number: {str(error)[:80]}; allowed: numbers") from error
    if np.isinf(array).any():
        raise SourceError(f"{where}: found an infinite value; allowed: finite numbers")
    return array


def clock(times: object, where: str) -> Float[np.ndarray, " samples"]:
    """Times that increase; SourceError names the first that does not."""
    time = numbers(times, where)
    if time.ndim != 1 or not len(time):
        raise SourceError(f"{where}: found {time.shape} times; allowed: one a sample, and at least one")
    wrong = np.flatnonzero(~np.isfinite(time))
    if len(wrong):
        raise SourceError(f"{where}: row {wrong[0] + 1}: found no time; allowed: a number in every row")
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        before, after = float(time[back[0]]), float(time[back[0] + 1])
        raise SourceError(f"{where}: row {back[0] + 2}: found {after!r} after {before!r}; allowed: only increasing")
    return time


def files(source: Path, *suffixes: str) -> list[Path]:
    """The source itself, or a folder's files with these suffixes, in order of their names."""
    if not source.exists():
        raise SourceError(f"{source}: no such file or folder; allowed: {listing(suffixes)}, or a folder of them")
    found = sorted(p for p in source.iterdir() if p.suffix.lower() in suffixes) if source.is_dir() else [source]
    if not found or found[0].suffix.lower() not in suffixes:
        what = f"a '{source.suffix}' file" if source.is_file() else "no such file in the folder"
        raise SourceError(f"{source}: found {what}; allowed: {listing(suffixes)}")
    return found
