"""What study.toml or psi.toml says, and the files it points to; nothing here knows the model."""

import tomllib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from det2stoc_bayes.errors import StudyError, listing
from det2stoc_bayes.recording import LARGEST, StudyWarning
from det2stoc_bayes.suggestions import choices

FILES = ("study.toml", "psi.toml")
LEAST = 1e-30  # of a noise sd, in SI units: its square must stay a number
ALLOWED = {"known": "a finite number, or a list of them", "noise": f"a number from {LEAST:g} to {LARGEST:g}"}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class PsiTable(_Strict):
    target: str
    prior: dict[str, Any]
    index: list[int] | None = None
    varies: Literal["never", "trajectory"] = "never"


_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Noise = Annotated[float, Field(ge=LEAST, le=LARGEST)]


class LikelihoodTable(_Strict):
    noise: Literal["normal", "student_t"] = "normal"
    degrees_of_freedom: _Positive = 4.0


class StudyFile(_Strict):
    model: str = "model.xml"
    recordings: str = "recordings/*.csv"
    holdout: str = "holdout/*.csv"
    psi: dict[str, PsiTable] = {}
    noise: dict[str, _Noise] = {}
    likelihood: LikelihoodTable = LikelihoodTable()
    known: dict[str, dict[str, _Finite | list[_Finite]]] = {}


def read_toml(folder: Path) -> tuple[str, StudyFile]:
    """The file's name and content; study.toml goes before psi.toml."""
    there = [name for name in FILES if (folder / name).is_file()]
    if not there:
        found = listing(sorted(p.name + "/" * p.is_dir() for p in folder.iterdir()))
        raise StudyError(f"{folder.name}: found neither {' nor '.join(FILES)} but {found}; allowed: one of the two")
    source = there[0]
    if len(there) > 1:
        warnings.warn(f"{there[1]} is not read, since there is a {source}", StudyWarning, stacklevel=3)
    try:
        content = tomllib.loads(inside(folder, source, folder.name).read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise StudyError(f"{source}: {error}; allowed: TOML (names with a slash are quoted)") from error
    try:
        return source, StudyFile.model_validate(content)
    except ValidationError as error:
        raise StudyError(f"{source}: {_first_problem(error)}") from error


def _first_problem(error: ValidationError) -> str:
    """pydantic's first complaint on one line: key path, what was found, what is allowed."""
    first, *rest = error.errors(include_url=False)
    # Below a known value pydantic goes on with the alternatives of its type, which are no keys of the file.
    path = [str(part) for part in (first["loc"][:3] if first["loc"][0] == "known" else first["loc"])]
    more = f" (and {len(rest)} more)" if rest and first["loc"][0] != "known" else ""
    key, found = ".".join(path), first["input"]
    if first["type"] == "extra_forbidden":
        table = {"psi": PsiTable, "likelihood": LikelihoodTable}.get(path[0] if len(path) > 1 else "", StudyFile)
        return f"{key}: unknown key; {choices(path[-1], table.model_fields)}{more}"
    if first["type"] == "missing":
        return f"{key}: missing; found {listing(found)}; allowed: {listing(PsiTable.model_fields)}{more}"
    allowed = ALLOWED.get(path[0]) or first["msg"].removeprefix("Input should be ")
    for python, toml in (("a valid dictionary", "a table"), ("a valid string", "a text in quotes")):
        allowed = allowed.replace(python, toml)
    found = repr(found[:60]) if isinstance(found, str) else repr(found)[:60]
    return f"{key}: found {found}; allowed: {allowed}{more}"


def inside(folder: Path, name: str, where: str) -> Path:
    """The path of a file in the folder, also once links and dots are followed."""
    if not (folder / name).resolve().is_relative_to(folder.resolve()):
        raise StudyError(f"{where}: '{name}' lies outside of the study's folder; allowed: files within it")
    return folder / name


def find_files(folder: Path, pattern: str, where: str) -> list[Path]:
    """The files that match, in order of their names."""
    if not pattern or Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        raise StudyError(f"{where}: found '{pattern}'; allowed: files within the study's folder, as data/*.csv")
    try:
        found = sorted(folder.glob(pattern))
    except (ValueError, IndexError, AttributeError) as error:  # the latter two of pathlib at "." and "./"
        raise StudyError(f"{where}: found '{pattern}': {error}; allowed: a pattern, as data/*.csv") from error
    return [inside(folder, str(path.relative_to(folder)), where) for path in found]


def check_stems(files: Sequence[Path], held_out: Sequence[Path], known: Mapping[str, Any], source: str) -> None:
    """A stem names one recording; fitted and held-out ones may share one unless [known] means either."""
    both = set(files) & set(held_out)
    if both:
        path = f"{min(both).parent.name}/{min(both).name}"
        raise StudyError(f"{source}: holdout: {path} is among the recordings too; allowed: files that are never fitted")
    for paths in (files, held_out):
        stems = [path.stem for path in paths]
        for path in paths:
            if stems.count(path.stem) > 1:
                same = listing(f"{p.parent.name}/{p.name}" for p in paths if p.stem == path.stem)
                raise StudyError(f"{source}: recordings: found '{path.stem}' twice: {same}; allowed: each name once")
    stems = [path.stem for path in (*files, *held_out)]
    for stem in known:
        if stem not in stems:
            raise StudyError(f"{source}: known.{stem}: no such recording; {choices(stem, stems)}")
        if stems.count(stem) > 1:
            raise StudyError(f"{source}: known.{stem}: found it in recordings and in holdout; allowed: a name of one")
