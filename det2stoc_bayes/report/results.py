"""Results in a folder, of whatever command: where they are, what they say, and their numbers side by side."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.report import result_facts
from det2stoc_bayes.report.result_facts import Facts

MARKS = {  # the file by which a folder is known, the command's own last one
    "diagnosis.json": "diagnosis",
    "comparison.json": "comparison",
    "calibration.json": "calibration",
    "blind.json": "blind",
    "results.json": "reproduction",
    "fit.nc": "fit",
}
MOST_FOLDERS = 20_000  # that are looked into
MOST_BYTES = 60_000_000  # of a file that is read


@dataclass(frozen=True)
class Result:
    """One run: its folder below the root (`.` is the root), and what it says in a line and in numbers."""

    folder: str
    kind: str
    name: str
    verdict: str
    headline: str
    written: float  # seconds since 1970
    files: tuple[str, ...] = ()
    facts: Facts = field(default=())

    @property
    def report(self) -> str | None:
        """Its page below the root."""
        return self.at("report.html") if "report.html" in self.files else None

    def at(self, file: str) -> str:
        """A file's place below the root."""
        return file if self.folder == "." else f"{self.folder}/{file}"


def find(root: Path) -> list[Result]:
    """All results below a folder, latest first; links are not followed, hidden folders not entered."""
    return sorted((read(root, folder) for folder in _folders(root)), key=lambda r: (-r.written, r.folder))


def read(root: Path, folder: str) -> Result:
    """The result in a folder below the root; what cannot be read says so.

    Raises Det2StocError where there is none.
    """
    home = root / folder
    mark = next((name for name in MARKS if (home / name).is_file()), None)
    if mark is None:
        raise Det2StocError(f"{home}: found no result; allowed: a folder with one of {', '.join(MARKS)}")
    told = (home / mark).stat()
    return _read(root, folder, mark, told.st_mtime_ns, told.st_size, tuple(sorted(_files(home))))


@lru_cache(maxsize=2000)
def _read(root: Path, folder: str, mark: str, stamp: int, size: int, files: tuple[str, ...]) -> Result:
    kind, home = MARKS[mark], root / folder
    name, seconds = home.name if folder != "." else root.resolve().name, stamp / 1e9
    try:
        content = home if kind == "fit" else _json(home / mark, size)
        verdict, headline, facts = result_facts.READERS[kind](content)
    except Det2StocError as error:
        return Result(folder, kind, name, "unreadable", str(error), seconds, files)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        return Result(folder, kind, name, "unreadable", f"{mark} {_fault(error)}", seconds, files)
    return Result(folder, kind, name, verdict, headline, seconds, files, facts)


def _fault(error: Exception) -> str:
    """What is wrong with a file that is not as a command writes it."""
    if isinstance(error, json.JSONDecodeError):
        return f"is no JSON: {error}"
    if isinstance(error, UnicodeDecodeError):
        return "is no text in UTF-8"
    if isinstance(error, KeyError):
        return f"lacks the key {error}"
    return "has values of another kind than det2stoc writes"


def _json(path: Path, size: int) -> dict[str, Any]:
    if size > MOST_BYTES:
        raise Det2StocError(f"{path.name}: found {size} bytes; allowed: {MOST_BYTES}")
    content = json.loads(path.read_text("utf-8"))
    if not isinstance(content, dict):
        raise ValueError("found no table")
    return content


def _folders(root: Path) -> Iterator[str]:
    for k, (here, below, files) in enumerate(os.walk(root)):
        if k >= MOST_FOLDERS:
            return
        below[:] = sorted(name for name in below if not name.startswith("."))
        if any(name in MARKS and not (Path(here) / name).is_symlink() for name in files):
            yield Path(here).relative_to(root).as_posix()


def _files(home: Path) -> Iterator[str]:
    return (p.name for p in home.iterdir() if p.is_file() and not p.is_symlink() and not p.name.startswith("."))
