"""Signals of a log as the columns of a study's recording: units, delays, the phase of controls, one clock."""

from fnmatch import fnmatchcase

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import PHASES, Asked, Contents, Log, Mapped, Phase, Signal, SourceError
from det2stoc_bayes.importers.units import allowed, factor, quantity_of
from det2stoc_bayes.recording_npz import merged
from det2stoc_bayes.suggestions import choices

Rows = Float[np.ndarray, "samples columns"]


def assigned(log: Log, asked: Asked, names: ModelNames) -> dict[str, Mapped]:
    """Column -> signal: what the user said, then the signals that bear a column's very name."""
    known = [*names.columns, *(f"ctrl/{name}" for name in names.actuators if name)]
    found = dict(asked.columns)
    for column, mapped in found.items():
        if column not in known:
            raise SourceError(f"--column {column}: the model has no such column; {choices(column, known, 30)}")
        if mapped.signal not in log.signals:
            raise SourceError(
                f"--column {column}: {log.origin} has no signal '{mapped.signal}'; "
                f"{choices(mapped.signal, log.signals, 30)}"
            )
    taken = {mapped.signal for mapped in found.values()}
    for name, signal in log.signals.items():
        if signal.column in known and signal.column not in asked.columns and name not in taken:
            if signal.column in found:
                both = f"'{found[signal.column].signal}' and '{name}'"
                raise SourceError(f"{log.origin}: {both} are both {signal.column}; give --column {signal.column}=...; "
                                  "allowed: one signal a column")  # fmt: skip
            found[signal.column] = Mapped(name)
    if not set(found) & set(names.columns):
        raise SourceError(
            f"{log.origin}: no signal bears the name of a measured column of the model; give --column COLUMN=SIGNAL; "
            f"allowed: a column of {listing(names.columns, 20)} from a signal of {listing(log.signals, 30)}"
        )
    return {column: found[column] for column in known if column in found}


def table(
    log: Log, contents: Contents, asked: Asked, names: ModelNames
) -> tuple[tuple[str, ...], Rows, float, list[str]]:
    """A recording's header and rows (time first, from 0), the time that became 0, and what was done to each column."""
    chosen = assigned(log, asked, names)
    for column in asked.delays:
        if column not in chosen:
            raise SourceError(f"--delay {column}: no such column is imported; {choices(column, chosen, 30)}")
    phase = asked.phase or contents.phase
    if phase is None and any(column.startswith("ctrl/") for column in chosen):
        told = "; ".join(f"{name}: {what}" for name, what in PHASES.items())
        raise SourceError(f"{log.origin}: when a row's control acts is not in the file; give --phase; allowed: {told}")
    parts, notes = [], []
    for column, mapped in chosen.items():
        signal = log.signals[mapped.signal]
        unit = _unit(column, mapped, signal, asked, names, log.origin)
        size = factor(unit, column, names, f"--unit {column}")
        time = signal.time - asked.delays.get(column, 0.0)
        if phase is not None and column.startswith("ctrl/"):
            time, values = _held(time, signal.values, phase)
        else:
            values = signal.values
        parts.append((time, (mapped.scale * size * values + mapped.offset)[:, None]))
        notes.append(_told(column, mapped, unit, asked.delays.get(column, 0.0), phase))
    time, values = merged(parts)
    measured = np.array([not column.startswith("ctrl/") for column in chosen])
    seen = np.flatnonzero(~np.isnan(values[:, measured]).all(axis=1))
    if len(seen) < 2:
        raise SourceError(f"{log.origin}: found {len(seen)} measured samples; allowed: 2 or more")
    values = _held_into(values, ~measured, int(seen[0]))
    rows = slice(int(seen[0]), int(seen[-1]) + 1)
    start = float(time[seen[0]])
    return ("time", *chosen), np.column_stack([time[rows] - start, values[rows]]), start, notes


def _unit(column: str, mapped: Mapped, signal: Signal, asked: Asked, names: ModelNames, where: str) -> str:
    """The unit of a column's signal: of its mapping, then of --unit, then of the file or format."""
    if mapped.unit is not None:
        return mapped.unit
    matching = [unit for pattern, unit in asked.units.items() if column == pattern or fnmatchcase(column, pattern)]
    if matching:
        return asked.units.get(column, matching[-1])
    if signal.unit is not None:
        return signal.unit
    if quantity_of(column, names) == "number":
        return "1"  # a quaternion's component has none
    raise SourceError(
        f"{where}: the unit of '{mapped.signal}', which is {column}, is not in the file; give --unit {column}=...; "
        f"allowed: {listing(allowed(quantity_of(column, names)), 40)}"
    )


def _held(
    time: Float[np.ndarray, " samples"], values: Float[np.ndarray, " samples"], phase: Phase
) -> tuple[Float[np.ndarray, " acting"], Float[np.ndarray, " acting"]]:
    """Controls with the times from which they act."""
    if phase == "after" or len(time) < 2:
        return time, values
    if phase == "before":
        return time[:-1], values[1:]
    return np.concatenate([time[:1], (time[1:] + time[:-1]) / 2]), values


def _held_into(values: Rows, controls: np.ndarray, first: int) -> Rows:
    """A control that was given before the first measured row still acts there."""
    out = values.copy()
    for j in np.flatnonzero(controls):
        before = out[: first + 1, j]
        given = before[~np.isnan(before)]
        out[first, j] = given[-1] if len(given) else np.nan
    return out


def _told(column: str, mapped: Mapped, unit: str, delay: float, phase: Phase | None) -> str:
    """What was done to a column, for SOURCE.md."""
    told = [f"`{column}` from `{mapped.signal}`, unit {unit}"]
    told += [f"times {mapped.scale:g}"] if mapped.scale != 1 else []
    told += [f"plus {mapped.offset:g}"] if mapped.offset else []
    told += [f"{delay:g} s older than its stamp"] if delay else []
    told += [f"phase {phase}: {PHASES[phase]}"] if phase is not None and column.startswith("ctrl/") else []
    return ", ".join(told)
