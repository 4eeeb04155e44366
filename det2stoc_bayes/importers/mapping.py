"""What the user says of a source: a mapping file (TOML), and options, which go before it."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import PHASES, Asked, Mapped, Phase, SourceError
from det2stoc_bayes.suggestions import choices

_Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ColumnTable(_Strict):
    signal: str
    unit: str | None = None
    scale: _Finite = 1.0
    offset: _Finite = 0.0
    delay: _Finite = 0.0


class MapFile(_Strict):
    clock: str | None = None
    period: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    phase: Phase | None = None
    only: str = "*"
    holdout: str | None = None
    columns: dict[str, ColumnTable] = {}
    units: dict[str, str] = {}
    settings: dict[str, str] = {}


def read_map(path: Path | None) -> MapFile:
    """The mapping file, or an empty one; SourceError names the key that is wrong."""
    if path is None:
        return MapFile()
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        reason = (error.strerror or "") if isinstance(error, OSError) else str(error)
        raise SourceError(f"--map {path}: {reason}; allowed: TOML with {listing(MapFile.model_fields)}") from error
    try:
        return MapFile.model_validate(content)
    except ValidationError as error:
        raise SourceError(f"--map {path.name}: {_problem(error)}") from error


def _problem(error: ValidationError) -> str:
    """pydantic's first complaint on one line."""
    first = error.errors(include_url=False)[0]
    path = [str(part) for part in first["loc"]]
    key, table = ".".join(path), ColumnTable if path[0] == "columns" and len(path) > 1 else MapFile
    if first["type"] == "extra_forbidden":
        return f"{key}: unknown key; {choices(path[-1], table.model_fields)}"
    if first["type"] == "missing":
        return f"{key}: missing; allowed: {listing(ColumnTable.model_fields)}"
    return f"{key}: found {str(first['input'])[:60]!r}; allowed: {first['msg'].removeprefix('Input should be ')}"


def asked(
    file: Path | None = None,
    *,
    columns: Sequence[str] = (),
    units: Sequence[str] = (),
    delays: Sequence[str] = (),
    settings: Sequence[str] = (),
    allowed_settings: Mapping[str, str] | None = None,
    **given: Any,
) -> Asked:
    """Options over the mapping file. `columns` are COLUMN=SIGNAL, `delays` COLUMN=SECONDS; `given` the others."""
    told = read_map(file)
    options = {name: value for name, value in given.items() if value is not None}
    mapped = {name: Mapped(t.signal, t.unit, t.scale, t.offset) for name, t in told.columns.items()}
    late = {name: table.delay for name, table in told.columns.items() if table.delay}
    for column, signal in _pairs("--column", columns, "COLUMN=SIGNAL").items():
        old = mapped.get(column, Mapped(signal))
        mapped[column] = Mapped(signal, old.unit, old.scale, old.offset)
    for column, text in _pairs("--delay", delays, "COLUMN=SECONDS").items():
        late[column] = _number("--delay", text)
    chosen = told.settings | _pairs("--set", settings, "NAME=VALUE")
    for name in chosen if allowed_settings is not None else ():
        if name not in (allowed_settings or {}):
            raise SourceError(f"--set {name}: no such setting of this format; {choices(name, allowed_settings or ())}")
    plain = {name: options.get(name, getattr(told, name)) for name in ("clock", "period", "phase", "only", "holdout")}
    if plain["phase"] is not None and plain["phase"] not in PHASES:
        raise SourceError(f"--phase: found '{plain['phase']}'; {choices(plain['phase'], PHASES)}")
    return Asked(mapped, told.units | _pairs("--unit", units, "COLUMN=UNIT"), late, settings=chosen, **plain)


def _pairs(option: str, given: Sequence[str], shape: str) -> dict[str, str]:
    found = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not (equals and name.strip() and value.strip()):
            raise SourceError(f"{option}: found '{text}'; allowed: {shape}")
        found[name.strip()] = value.strip()
    return found


def _number(option: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e9:
        raise SourceError(f"{option}: found '{text}'; allowed: a number of seconds, below 1e9")
    return value
