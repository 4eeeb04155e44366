"""Logs of benchmarks: one JSON line a result, beside what can be read of them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from det2stoc_bayes.files import appending


def append(path: Path, line: Mapping[str, Any]) -> None:
    """One more line of a log."""
    with appending(path) as (_, add):
        add(line)


def logged(path: Path) -> list[dict[str, Any]]:
    """The lines of a log; one that was cut off does not count."""
    with appending(path) as (lines, _):
        return lines
