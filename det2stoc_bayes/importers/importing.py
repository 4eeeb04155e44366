"""Recordings of another format, and a model, as a study: `det2stoc import`."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib.metadata import version
from pathlib import Path
from typing import Any

from det2stoc_bayes.engines.model_names import ModelNames, compile_model, model_names
from det2stoc_bayes.errors import listing
from det2stoc_bayes.files import write_all
from det2stoc_bayes.importers import get_format
from det2stoc_bayes.importers.base import Asked, Contents, Log, SourceError
from det2stoc_bayes.importers.columns import assigned, table
from det2stoc_bayes.importers.mapping import asked as asked_of
from det2stoc_bayes.importers.models import SETTINGS as MODEL_SETTINGS
from det2stoc_bayes.importers.models import ModelFiles, read_model
from det2stoc_bayes.importers.write import Table, read_psi, sha256, source_files, staged, study_text, write_study

MOST_NAMED = 40  # signals and files in SOURCE.md


@dataclass(frozen=True)
class Imported:
    """What was written: recordings' names, the signals that became no column, and whether psi was given."""

    folder: Path
    recordings: Sequence[str]
    holdout: Sequence[str]
    columns: Sequence[str]
    left_out: Sequence[str]
    has_psi: bool


def import_study(
    name: str,
    source: Path,
    out: Path,
    *,
    model: Path | None = None,
    psi: Path | None = None,
    map_file: Path | None = None,
    **options: Any,
) -> Imported:
    """Write a study of a source in the format `name` ("urdf": a model alone) to `out`, whole or not at all.

    `options`: those of `mapping.asked`. SourceError: what cannot be read, or is neither in the files nor given.
    """
    source, out = Path(source), Path(out)
    if name == "urdf":
        return _model_alone(source, out, psi, asked_of(map_file, **options, allowed_settings=MODEL_SETTINGS))
    form = get_format(name)
    if model is None:
        raise SourceError("--model: missing; allowed: the MJCF (.xml) or URDF (.urdf) that is believed")
    extra = MODEL_SETTINGS if Path(model).suffix.lower() == ".urdf" else {}
    asked = asked_of(map_file, **options, allowed_settings={**form.SETTINGS, **extra})
    for option in {"clock", "period"} - set(form.TAKES):
        if getattr(asked, option) is not None:
            allowed = listing(f"--{taken}" for taken in form.TAKES)
            raise SourceError(
                f"--{option}: found {getattr(asked, option)}, which {name} does not take; allowed: {allowed}"
            )
    if not source.exists():
        raise SourceError(f"{source}: no such file or folder; allowed: {form.ABOUT}")
    said, files = read_psi(psi), read_model(Path(model), asked)
    with staged(out) as folder:
        names = _names(folder, files)
        contents = form.read(source, asked, names)
        written, text = _tables(contents, asked, names)
        fitted, held = _split(written, asked)
        notes = _source_text(name, source, form.ABOUT, contents, files, text)
        toml = study_text(files.main, names, said, bool(held))
        write_study(folder, out, {"study.toml": toml.encode(), "SOURCE.md": notes}, fitted, held, str(source))
    columns = {column: None for made in written.values() for column in made.header[1:]}
    left = {signal: None for log in contents.logs for signal in _left_out(log, asked, names)}
    return Imported(out, tuple(fitted), tuple(held), tuple(columns), tuple(left), said is not None)


def _model_alone(source: Path, out: Path, psi: Path | None, asked: Asked) -> Imported:
    """A URDF as a study that still lacks its recordings."""
    if source.suffix.lower() != ".urdf":
        raise SourceError(f"{source}: found a '{source.suffix}' file; allowed: .urdf")
    said, files = read_psi(psi), read_model(source, asked)
    with staged(out) as folder:
        names = _names(folder, files)
        told = "\n".join(["# Where this model is from", "", *(f"- {note}" for note in files.notes), ""])
        toml = study_text(files.main, names, said, False)
        write_all(folder, {"study.toml": toml.encode(), "SOURCE.md": told.encode()})
    return Imported(out, (), (), names.columns, (), said is not None)


def _names(folder: Path, files: ModelFiles) -> ModelNames:
    """The names of the model once it lies in the study's folder."""
    write_all(folder, files.files)
    return model_names(compile_model(folder / files.main, folder))


def _tables(contents: Contents, asked: Asked, names: ModelNames) -> tuple[dict[str, Table], list[str]]:
    """Every log as a table, and the lines that SOURCE.md has of them."""
    if not contents.logs:
        raise SourceError(f"--only {asked.only}: no recording has such a name; allowed: a pattern that some match")
    found: dict[str, Table] = {}
    lines, done = ["| recording | from | samples | lasts [s] | begins at [s] |", "|---|---|---|---|---|"], {}
    for log in contents.logs:
        header, rows, start, told = table(log, contents, asked, names)
        name = _stem(log.name)
        if name in found:
            raise SourceError(f"{log.origin}: a second recording is called '{name}'; allowed: different names")
        found[name] = Table(header, rows)
        lines.append(f"| {name} | {log.origin} | {len(rows)} | {rows[-1, 0]:.6g} | {start:.9g} |")
        done |= dict.fromkeys(told)
    left = dict.fromkeys(signal for log in contents.logs for signal in _left_out(log, asked, names))
    told = [*done, f"not taken: {listing(left, MOST_NAMED)}"] if left else [*done]
    return found, [*lines, "", "Columns:", "", *(f"- {note}" for note in told)]


def _stem(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name).strip("_.") or "recording"


def _split(tables: Mapping[str, Table], asked: Asked) -> tuple[dict[str, Table], dict[str, Table]]:
    """Recordings and held-out ones by --holdout, a pattern of names."""
    if asked.holdout is None:
        return dict(tables), {}
    held = {name: t for name, t in tables.items() if fnmatchcase(name, asked.holdout)}
    fitted = {name: t for name, t in tables.items() if name not in held}
    if not held or not fitted:
        raise SourceError(
            f"--holdout: '{asked.holdout}' matches {len(held)} of {len(tables)} recordings; "
            f"allowed: some, not all, of {listing(tables)}"
        )
    return fitted, held


def _left_out(log: Log, asked: Asked, names: ModelNames) -> list[str]:
    used = {mapped.signal for mapped in assigned(log, asked, names).values()}
    return [name for name in log.signals if name not in used]


def _source_text(
    name: str, source: Path, about: str, contents: Contents, model: ModelFiles, text: Sequence[str]
) -> bytes:
    """SOURCE.md: what was read, and what was done to it."""
    files = source_files(source)
    sums = [
        f"  - {p.relative_to(source if source.is_dir() else source.parent)}: {sha256(p)}" for p in files[:MOST_NAMED]
    ]
    sums += [f"  - and {len(files) - MOST_NAMED} more"] if len(files) > MOST_NAMED else []
    lines = [f"# {source.name}", "", f"Written by `det2stoc import {name}`, version {version('det2stoc-bayes')}.", "",
             f"- Format: {about}", *(f"- {note}" for note in contents.notes), *(f"- Model: {n}" for n in model.notes),
             "- Times begin at 0 with the first measured sample. A value is taken to be of its stamp's time unless a",
             "  delay is named; nothing was interpolated or filtered.",
             "- Files read, with their SHA-256:", *sums, "", *text, ""]  # fmt: skip
    return "\n".join(lines).encode()
