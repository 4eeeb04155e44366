"""Logs of Rhoban's bam (a servo that moves a pendulum), a JSON file a run."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import Asked, Contents, Log, Signal, SourceError, clock, files, numbers

ABOUT = "JSON logs of Rhoban's bam: position, speed, goal_position, duty, volts (duty times supply voltage)"
TAKES: tuple[str, ...] = ()
SETTINGS = {
    "pwm-limit": "counts of full duty, where load is counted (885 of a Dynamixel XL330)",
    "torque": "on: up to where the motor is switched off; all: every row",
}
UNITS = {"position": "rad", "speed": "rad/s", "goal_position": "rad", "input_volts": "V"}
_WORDS = 2**15  # the PWM register is a signed 16-bit number that some recorders stored unsigned


def read(source: Path, asked: Asked, names: ModelNames) -> Contents:
    """Every file as a log. A recorder stamps a row halfway through reading its registers: a control is centred."""
    logs, notes = [], []
    for path in files(source, ".json"):
        if asked.wanted(path.stem):
            head, entries = load(path)
            logs.append(_log(path, entries, asked))
            told = ", ".join(
                f"{k} {head[k]}" for k in ("motor", "trajectory", "kp", "vin", "mass", "length") if k in head
            )
            notes.append(f"{path.name}: {told}" if told else path.name)
    return Contents(logs, notes)


def load(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What a log says of its run, and its rows; SourceError for other JSON."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise SourceError(f"{path.name}: cannot be read: {error}; allowed: JSON of bam") from error
    entries = content.get("entries") if isinstance(content, dict) else None
    if not isinstance(entries, list) or len(entries) < 2 or not all(isinstance(e, dict) for e in entries):
        found = type(content).__name__
        if isinstance(content, dict):
            found = f"{len(entries)} entries" if isinstance(entries, list) else listing(content or ("an empty table",))
        raise SourceError(f"{path.name}: found {found}; allowed: a table with 2 'entries' or more, as bam records them")
    return {k: v for k, v in content.items() if k != "entries"}, entries


def column(entries: list[dict[str, Any]], key: str, where: str) -> np.ndarray:
    """One register of every row, NaN where a row lacks it."""
    return numbers([np.nan if row.get(key) is None else row[key] for row in entries], f"{where}: entries: {key}")


def signed(load: np.ndarray) -> np.ndarray:
    """PWM counts with their sign."""
    return np.where(load >= _WORDS, load - 2 * _WORDS, load)


def _log(path: Path, entries: list[dict[str, Any]], asked: Asked) -> Log:
    entries = _switched_on(entries, asked, path.name)
    if any("timestamp" not in row for row in entries):
        raise SourceError(f"{path.name}: entries: found a row without 'timestamp'; allowed: one in every row")
    time = clock(column(entries, "timestamp", path.name), f"{path.name}: entries: timestamp")
    there = {key for row in entries for key in row}
    signals = {key: Signal(time, column(entries, key, path.name), UNITS[key]) for key in UNITS if key in there}
    if "load" in there:
        duty = _duty(entries, asked, path.name)
        signals["duty"] = Signal(time, duty, "1")
        if "input_volts" in signals:
            signals["volts"] = Signal(time, duty * signals["input_volts"].values, "V")
    return Log(path.stem, path.name, signals)


def _switched_on(entries: list[dict[str, Any]], asked: Asked, where: str) -> list[dict[str, Any]]:
    """The rows before the motor is switched off, if that is what is wanted."""
    off = [i for i, row in enumerate(entries) if row.get("torque_enable") is False]
    why = f"{where}: the motor is off from row {off[0] + 1} on; whether those rows are taken" if off else where
    if not off or asked.setting("torque", ("on", "all"), why) == "all":
        return entries
    if off[0] < 2:
        raise SourceError(
            f"{where}: the motor is off from row {off[0] + 1} on; allowed: 2 rows before, or --set torque=all"
        )
    return entries[: off[0]]


def _duty(entries: list[dict[str, Any]], asked: Asked, where: str) -> np.ndarray:
    """Load as a share of full duty: as it is, or counts over the limit that the user gives."""
    load = column(entries, "load", where)
    if "pwm-limit" in asked.settings:
        try:
            limit = float(asked.settings["pwm-limit"])
        except ValueError:
            limit = 0.0
        if not 0 < limit < np.inf:
            raise SourceError(f"--set pwm-limit: found '{asked.settings['pwm-limit']}'; allowed: a number above 0")
        return signed(load) / limit
    counted = all(isinstance(row.get("load"), int) for row in entries) or np.nanmax(np.abs(load)) > 1
    if counted:
        raise SourceError(
            f"{where}: entries: load is counted, and full duty is not in the file; give --set pwm-limit=...; "
            "allowed: the counts of full duty"
        )
    return load
