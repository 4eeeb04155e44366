"""Comma-separated text with a header, whose columns a map names. A header may bear units: `angle [deg]`."""

import csv
import re
from pathlib import Path

import numpy as np

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import Asked, Contents, Log, Signal, SourceError, clock, files
from det2stoc_bayes.suggestions import choices

ABOUT = "comma-separated text, a file a recording; --column says which of its columns are the model's"
TAKES = ("clock", "period")
SETTINGS = {"time": "the column of times (without it --period)", "delimiter": "comma, semicolon, tab or space"}
DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
_UNIT = re.compile(r"^(?P<name>.*?)\s*\[(?P<unit>[^\]]*)\]$")


def read(source: Path, asked: Asked, names: ModelNames) -> Contents:
    """Every file as a log; the time column is `--set time=NAME`, or the one called time."""
    paths = [path for path in files(source, ".csv", ".txt", ".tsv") if asked.wanted(path.stem)]
    return Contents([_log(path, asked) for path in paths])


def _log(path: Path, asked: Asked) -> Log:
    delimiter = DELIMITERS[asked.setting("delimiter", tuple(DELIMITERS), path.name, "comma")]
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file, delimiter=delimiter, strict=True) if any(c.strip() for c in row)]
    except (csv.Error, UnicodeDecodeError) as error:
        raise SourceError(f"{path.name}: cannot be read: {error}; allowed: {delimiter!r}-separated text") from error
    if len(rows) < 3:
        raise SourceError(f"{path.name}: found {max(len(rows) - 1, 0)} samples; allowed: a header and 2 or more")
    header = [_named(cell.strip()) for cell in rows[0]]
    names = [name for name, _ in header]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SourceError(f"{path.name}: found column '{twice[0]}' twice; allowed: each name once")
    cells = np.array([_numbers(row, names, f"{path.name}: row {i}") for i, row in enumerate(rows[1:], 2)])
    units = dict(header)
    time = _time(path.name, names, units, cells, asked)
    signals = {
        name: Signal(time, cells[:, j], units[name], name)
        for j, name in enumerate(names)
        if name != asked.settings.get("time", "time")
    }
    return Log(path.stem, path.name, signals)


def _time(where: str, names: list[str], units: dict[str, str | None], cells: np.ndarray, asked: Asked) -> np.ndarray:
    """The file's own times, or rows counted by --period."""
    chosen = asked.settings.get("time")
    if chosen is not None and chosen not in names:
        raise SourceError(f"--set time: {where} has no column '{chosen}'; {choices(chosen, names, 30)}")
    if chosen is None and "time" not in names:
        if asked.period is None:
            raise SourceError(f"{where}: no column 'time'; give --set time=NAME or --period; "
                              f"allowed: one of {listing(names, 30)}, or seconds from row to row")  # fmt: skip
        return asked.period * np.arange(len(cells))
    name = chosen or "time"
    if asked.period is not None:
        raise SourceError(f"{where}: has a column '{name}' of times; allowed: that, or --period for files without")
    return clock(cells[:, names.index(name)], f"{where}: column {name}") * asked.seconds(where, units[name])


def _named(cell: str) -> tuple[str, str | None]:
    """A header's name and the unit in brackets behind it."""
    match = _UNIT.match(cell)
    return (match["name"], match["unit"]) if match else (cell, None)


def _numbers(row: list[str], names: list[str], where: str) -> list[float]:
    if len(row) != len(names):
        raise SourceError(f"{where}: found {len(row)} cells; allowed: {len(names)}, as in the header")
    found = []
    for name, cell in zip(names, row, strict=True):
        try:
            found.append(float(cell) if cell.strip() else np.nan)
        except ValueError:
            found.append(np.inf)
        if np.isinf(found[-1]) or (np.isnan(found[-1]) and cell.strip()):
            raise SourceError(f"{where}: column {name}: found '{cell[:40]}'; allowed: a finite number, or nothing")
    return found
