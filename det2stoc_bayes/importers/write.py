"""A study's folder, which appears whole or not at all: staged beside its place, loaded once, then moved there."""

import hashlib
import os
import secrets
import shutil
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import ModelError, StudyError, listing
from det2stoc_bayes.files import check_folder, unwritable, write_all
from det2stoc_bayes.importers.base import SourceError
from det2stoc_bayes.study import load_study
from det2stoc_bayes.suggestions import choices

TABLES = ("psi", "noise", "known", "likelihood")  # of study.toml that are the user's to say
MOST_PLACEHOLDERS = 6


@dataclass(frozen=True, eq=False)
class Table:
    """A recording as it is written: the header begins with time [s]."""

    header: tuple[str, ...]
    rows: Float[np.ndarray, "samples columns"]


@contextmanager
def staged(out: Path) -> Iterator[Path]:
    """A folder beside `out` that takes its place on success. SourceError: `out` holds something already."""
    if out.is_dir() and any(out.iterdir()):
        raise SourceError(f"--out {out}: found files in it; allowed: a new name, or an empty folder")
    check_folder(out)
    out = out.resolve()
    folder = out.with_name(f".{secrets.token_hex(6)}.{out.name}")
    try:
        folder.mkdir(parents=True)
        yield folder
        if out.is_dir():
            out.rmdir()
        os.replace(folder, out)
    except OSError as error:
        raise unwritable(out, error) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_study(
    folder: Path,
    out: Path,
    files: Mapping[str, bytes],
    recordings: Mapping[str, Table],
    holdout: Mapping[str, Table],
    whence: str,
    digits: int | None = None,
) -> None:
    """Fill a staged folder, and load it. SourceError where that fails, as of `out`, where the study will lie."""
    texts = {f"recordings/{name}.csv": csv_text(table, digits) for name, table in recordings.items()}
    texts |= {f"holdout/{name}.csv": csv_text(table, digits) for name, table in holdout.items()}
    write_all(folder, {**files, **texts})
    try:
        load_study(folder)
    except (StudyError, ModelError) as error:
        raise SourceError(f"{whence} makes no study: {str(error).replace(folder.name, out.name)}") from error


def csv_text(table: Table, digits: int | None = None) -> bytes:
    """Comma-separated text, numbers in full or with so many digits; NaN is an empty cell."""
    lines = [",".join(table.header)]
    for time, *values in table.rows.tolist():
        cells = [time if digits else round(time, 9), *values]
        lines.append(",".join("" if v != v else (f"{v:.{digits}g}" if digits else repr(v)) for v in cells))
    return ("\n".join(lines) + "\n").encode()


def read_psi(path: Path | None) -> str | None:
    """The text of --psi: a TOML file of psi, noise, known and likelihood."""
    if path is None:
        return None
    try:
        text = path.read_text(encoding="utf-8-sig")
        content = tomllib.loads(text)
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        reason = (error.strerror or "") if isinstance(error, OSError) else str(error)
        raise SourceError(f"--psi {path}: {reason}; allowed: TOML with {listing(TABLES)}") from error
    for key in content:
        if key not in TABLES:
            raise SourceError(f"--psi {path.name}: {key}: unknown key; {choices(key, TABLES)}")
    return text


def study_text(model: str, names: ModelNames, psi: str | None, has_holdout: bool) -> str:
    """study.toml; without psi, commented examples of this model's parameters for the user to fill in."""
    head = [f'model = "{model}"', 'recordings = "recordings/*.csv"', *(['holdout = "holdout/*.csv"'] * has_holdout)]
    if psi is not None:
        return "\n".join([*head, "", psi.strip(), ""])
    text = [*head, "", "# Say which parameters are uncertain, and how much: take away the '#' and fill in the numbers.",
            "# Until then the study can be read and checked, but there is nothing to infer."]  # fmt: skip
    for kind, name, field in _placeholders(names):
        called = "".join(c if c.isalnum() else "_" for c in f"{name}_{field}")
        text += ["", f"# [psi.{called if called[0].isalpha() else f'psi_{called}'}]",
                 f'# target = "{kind}/{name}/{field}"',
                 "# prior = { LogNormal = { loc = ..., scale = ... } }"]  # fmt: skip
    text += ["", "# [noise]                # 1 sd of the measurement noise; a column left out has its noise estimated",
             '# "qpos/*" = ...', ""]  # fmt: skip
    return "\n".join(text)


def _placeholders(names: ModelNames) -> list[tuple[str, str, str]]:
    joints = [("joint", name, "damping") for name in names.elements.get("joint", ())]
    bodies = [("body", name, "mass") for name in names.elements.get("body", ())]
    return [*joints[: MOST_PLACEHOLDERS // 2], *bodies[: MOST_PLACEHOLDERS // 2]]


def sha256(path: Path) -> str:
    """The checksum of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def source_files(source: Path) -> Sequence[Path]:
    """The files of a source, for their checksums."""
    return sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
