"""The cells of a recorded file, with the line each stands on."""

import csv
import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.errors import StudyError

Header = Callable[[str, tuple[str, ...]], None]  # raises if the columns are wrong, before any cell is read


@dataclass(frozen=True, eq=False)
class Table:
    """A file's cells: NaN where empty. `lines` counts from 1 and names a row in messages, as `unit`."""

    label: str
    header: tuple[str, ...]
    cells: Float[np.ndarray, "samples header"]
    lines: Sequence[int]
    unit: str

    def fail(self, problem: str, row: int | None = None) -> StudyError:
        place = "" if row is None else f"{self.unit} {self.lines[row]}: "
        return StudyError(f"{self.label}: {place}{problem}")

    def column(self, name: str) -> Float[np.ndarray, " samples"]:
        return self.cells[:, self.header.index(name)]


def read_csv(path: Path, label: str, check: Header) -> Table:
    """Comma-separated text with a header; a wrong cell is named by its line and column."""
    cells, lines = array("d"), array("q")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            header = tuple(name.strip() for name in next((row for row in reader if row), ()))
            _check_unique(label, header)
            check(label, header)
            for row in reader:
                if len(row) > 1 or (row and row[0].strip()):  # blank lines are no samples
                    cells.extend(_numbers(row, header, f"{label}: line {reader.line_num}"))
                    lines.append(reader.line_num)
    except (csv.Error, UnicodeDecodeError) as error:
        raise StudyError(f"{label}: cannot be read: {error}; allowed: comma-separated UTF-8 text") from error
    return Table(label, header, np.array(cells).reshape(len(lines), len(header)), lines, "line")


def _numbers(row: list[str], header: tuple[str, ...], where: str) -> list[float]:
    """One line's numbers; NaN stands for an empty cell alone."""
    if len(row) != len(header):
        raise StudyError(f"{where}: found {len(row)} cells; allowed: {len(header)}, as in the header")
    numbers = []
    for column, cell in zip(header, row, strict=True):
        try:
            number = float(cell)
        except ValueError:
            number = math.nan if not cell.strip() else math.inf
        if not math.isfinite(number) and cell.strip():
            allowed = "in every line" if column == "time" else "or nothing"
            raise StudyError(f"{where}: column {column}: found '{cell[:40]}'; allowed: a finite number, {allowed}")
        numbers.append(number)
    return numbers


def read_parquet(path: Path, label: str, check: Header) -> Table:
    """Numeric columns; null is an empty cell, NaN a mistake."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path) as file:
            content = file.read()
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise StudyError(f"{label}: cannot be read: {reason}; allowed: a Parquet file") from error
    header = tuple(content.column_names)
    _check_unique(label, header)
    check(label, header)
    cells = np.empty((content.num_rows, len(header)))
    lines = range(1, content.num_rows + 1)
    for j, (name, column) in enumerate(zip(header, content.columns, strict=True)):
        if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
            raise StudyError(f"{label}: column {name}: found {column.type} values; allowed: numbers")
        cells[:, j] = column.cast(pa.float64(), safe=False).to_numpy()
        wrong = np.flatnonzero(~np.isfinite(cells[:, j]) & ~column.is_null().to_numpy())
        if len(wrong):
            raise StudyError(
                f"{label}: row {wrong[0] + 1}: column {name}: found {cells[wrong[0], j]}; "
                "allowed: a finite number, or null for a dropped sample"
            )
    return Table(label, header, cells, lines, "row")


def _check_unique(label: str, header: tuple[str, ...]) -> None:
    if not header:
        raise StudyError(f"{label}: found an empty file; allowed: a header, then samples")
    twice = sorted({name for name in header if header.count(name) > 1})
    if twice:
        raise StudyError(f"{label}: found column '{twice[0]}' {header.count(twice[0])} times; allowed: each name once")
