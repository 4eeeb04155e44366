"""A study: what the user brought, named, validated and frozen."""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.allowed_values import NOT_NEGATIVE, check_value
from det2stoc_bayes.engines.model_names import (
    KINDS,
    REFUSED,
    ModelNames,
    believed_value,
    compile_model,
    model_names,
    rows_of,
)
from det2stoc_bayes.errors import StudyError, listing
from det2stoc_bayes.measurement import Measurement
from det2stoc_bayes.priors import Prior
from det2stoc_bayes.recording import Recording, StudyWarning, read_recording
from det2stoc_bayes.recording_clocks import check_clocks
from det2stoc_bayes.study_file import FILES, LikelihoodTable, PsiTable, check_stems, find_files, inside, read_toml
from det2stoc_bayes.study_places import places, warn_of_known
from det2stoc_bayes.suggestions import choices

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class Target:
    """A field of one element, of all of a kind (name `*`) or of opt (name ""): `pair/floor_box/friction`."""

    kind: str
    name: str
    field: str

    def __str__(self) -> str:
        return "/".join(part for part in (self.kind, self.name, self.field) if part)

    @classmethod
    def parse(cls, text: str) -> "Target":
        """From kind/name/field. An element's own name may hold a slash."""
        kind, _, rest = text.partition("/")
        name, _, field = rest.rpartition("/")
        if kind not in KINDS or not field or bool(name) == (kind == "opt"):
            raise StudyError(f"found '{text}'; allowed: kind/name/field with kind {listing(KINDS[:-1])}, or opt/field")
        return cls(kind, name, field)


@dataclass(frozen=True)
class Parameter:
    """An uncertain simulator parameter: it sets the components `index` of a vector field."""

    name: str
    target: Target
    index: tuple[int, ...] | None
    prior: Prior
    varies: Literal["never", "trajectory"] = "never"
    declared: Prior | None = None  # the study's own prior, where another one took its place


@dataclass(frozen=True, eq=False)
class Study:
    """A validated study. `noise`: measured column -> 1 sd, for the columns whose noise is given.

    `known`: recording -> target -> the field's value for that recording, in the field's whole shape.
    """

    folder: Path
    name: str
    model_path: Path
    parameters: tuple[Parameter, ...]
    noise: Mapping[str, float]
    known: Mapping[str, Mapping[Target, Float[np.ndarray, "..."]]]
    recordings: tuple[Recording, ...]
    holdout: tuple[Recording, ...]
    names: ModelNames
    measurement: Measurement = Measurement()


def load_study(folder: Path) -> Study:
    """The study in a folder: all of it read and checked, or one StudyError or ModelError."""
    folder = Path(folder)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise StudyError(f"{folder}: {found}; allowed: a folder with {' or '.join(FILES)}")
    source, content = read_toml(folder)
    model_path = inside(folder, content.model, f"{source}: model")
    model = compile_model(model_path, folder)
    names = model_names(model)
    parameters = tuple(_parameter(n, t, model, names, f"{source}: psi.{n}") for n, t in content.psi.items())
    _check_together(parameters, model, source)
    files = find_files(folder, content.recordings, f"{source}: recordings")
    held_out = find_files(folder, content.holdout, f"{source}: holdout")
    if not files:
        raise StudyError(f"{source}: recordings: no file matches '{content.recordings}'; allowed: one or more")
    if not held_out and "holdout" in content.model_fields_set:
        nothing = f"{source}: holdout: no file matches '{content.holdout}'; a diagnosis sets recordings aside itself"
        warnings.warn(nothing, StudyWarning, stacklevel=2)
    check_stems(files, held_out, content.known, source)
    recordings = tuple(read_recording(path, names) for path in files)
    holdout = _apart(tuple(read_recording(path, names) for path in held_out), {r.name for r in recordings})
    check_clocks((*recordings, *holdout), model.opt.timestep)
    _warn_of_copies((*recordings, *holdout), len(recordings))
    _warn_of_controls((*recordings, *holdout), names)
    noise = _noise(content.noise, [c for r in (*recordings, *holdout) for c in r.columns], names, source)
    known = {stem: _known(values, model, names, f"{source}: known.{stem}") for stem, values in content.known.items()}
    warn_of_known(parameters, known, model, source)
    measurement = _measurement(content.likelihood, source)
    name = folder.resolve().name
    return Study(folder, name, model_path, parameters, noise, known, recordings, holdout, names, measurement)


def _apart(holdout: tuple[Recording, ...], fitted: set[str]) -> tuple[Recording, ...]:
    """Held-out recordings under names that no fitted one has: results go by names."""
    taken, out = {*fitted, *(r.name for r in holdout)}, []
    for r in holdout:
        name = r.name
        while name in fitted or (name != r.name and name in taken):
            name = f"holdout_{name}"
        taken.add(name)
        out.append(r if name == r.name else replace(r, name=name))
    return tuple(out)


def _warn_of_copies(recordings: Sequence[Recording], num_fitted: int) -> None:
    seen: dict[bytes, str] = {}
    for i, r in enumerate(recordings):
        first = seen.setdefault(r.time.tobytes() + r.values.tobytes(), r.name)
        if first != r.name:
            why = "counts twice" if i < num_fitted else "is no proof of anything"
            message = f"{r.name}: the same samples as {first}: a recording that is fitted and given again {why}"
            warnings.warn(message, StudyWarning, stacklevel=3)


def _resolved(text: str, model: "mujoco.MjModel", names: ModelNames, where: str) -> tuple[Target, tuple[int, ...]]:
    """A target that the model has, and the shape of its field."""
    try:
        target = Target.parse(text)
    except StudyError as error:
        raise StudyError(f"{where}: {error}") from error
    kind, name, field = target.kind, target.name, target.field
    if (kind, field) in REFUSED:
        reason = REFUSED[kind, field]
        raise StudyError(f"{where}: '{text}': {reason}; allowed: {listing(names.fields[kind], 30)}")
    if field not in names.fields[kind]:
        raise StudyError(f"{where}: '{text}': {kind} has no field '{field}'; {choices(field, names.fields[kind], 30)}")
    if kind != "opt" and name != "*" and name not in names.elements[kind]:
        allowed = choices(name, [*names.elements[kind], "*"])
        raise StudyError(f"{where}: '{text}': the model has no {kind} named '{name}'; {allowed}")
    if not len(rows_of(model, kind, name, field)):
        raise StudyError(f"{where}: '{text}': the model has no such {kind}; allowed: an element that has a {field}")
    return target, names.fields[kind][field]


def _warn_of_controls(recordings: Sequence[Recording], names: ModelNames) -> None:
    for name in filter(None, names.actuators):
        without = [r.name for r in recordings if f"ctrl/{name}" not in r.commanded]
        if without:
            message = f"ctrl/{name}: no such column in {listing(without, 5)}; the control is taken to be 0 there"
            warnings.warn(message, StudyWarning, stacklevel=3)


def _check_sign(parameter: Parameter, where: str) -> None:
    """A mass cannot be negative, whatever the prior says."""
    low, high = parameter.prior.support
    if parameter.target.field not in NOT_NEGATIVE or low >= 0:
        return
    what = f"{parameter.target} is never negative"
    if high <= 0:
        raise StudyError(f"{where}.prior: found a support from {low:g} to {high:g}; allowed: above 0, since {what}")
    unlikely = float(parameter.prior.from_normal(np.array(UNLIKELY)))
    if unlikely < 0:
        message = f"{where}.prior: {what}, but the prior falls below {unlikely:.3g} with probability 0.1 %"
        warnings.warn(message, StudyWarning, stacklevel=5)


def _measurement(table: LikelihoodTable, source: str) -> Measurement:
    if table.noise == "student_t":
        return Measurement(table.degrees_of_freedom)
    if "degrees_of_freedom" in table.model_fields_set:
        raise StudyError(
            f'{source}: likelihood.degrees_of_freedom: found {table.degrees_of_freedom:g} with noise = "normal"; '
            'allowed: with noise = "student_t"'
        )
    return Measurement()


UNLIKELY = -3.0902  # standard normal quantile of 0.1 %
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
_RESERVED = ("chain", "draw", "recording", "time")  # dimensions of the results


def _parameter(name: str, table: PsiTable, model: "mujoco.MjModel", names: ModelNames, where: str) -> Parameter:
    if not _NAME.fullmatch(name) or name in _RESERVED:
        raise StudyError(
            f"{where}: found the name '{name}'; allowed: letters, digits, _, - and not {listing(_RESERVED)}"
        )
    target, shape = _resolved(table.target, model, names, f"{where}.target")
    prior = Prior.parse(table.prior, f"{where}.prior")
    if table.varies == "trajectory" and not np.isfinite(prior.sd):
        raise StudyError(
            f"{where}.varies: found a prior of {prior.family}, which has no standard deviation; "
            "allowed: 'never', or a prior that has one"
        )
    parameter = Parameter(name, target, _index(table.index, shape, where, target), prior, table.varies)
    _check_sign(parameter, where)
    low, high = prior.support
    believed = believed_value(model, target.kind, target.name, target.field)
    chosen = believed if parameter.index is None else believed[:, list(parameter.index)]
    outside = chosen[(chosen < low) | (chosen > high)]
    if len(outside):
        message = f"{where}: the model's {target} = {outside[0]:g} lies outside of the prior's {low:g} to {high:g}"
        warnings.warn(message, StudyWarning, stacklevel=4)
    return parameter


def _index(given: list[int] | None, shape: tuple[int, ...], where: str, target: Target) -> tuple[int, ...] | None:
    """The components that the parameter sets, all to its one value."""
    if not shape:
        if given is not None:
            raise StudyError(f"{where}.index: found {given}, but {target} is one number; allowed: no index")
        return None
    size = shape[0]
    if given is None:
        raise StudyError(f"{where}.index: missing: {target} has {size} components; allowed: a list of 0 to {size - 1}")
    if not given or len(set(given)) < len(given) or not all(0 <= i < size for i in given):
        raise StudyError(f"{where}.index: found {given}; allowed: different components from 0 to {size - 1}")
    return tuple(given)


def _check_together(parameters: Sequence[Parameter], model: "mujoco.MjModel", source: str) -> None:
    """No two parameters set the same number, or appear under one name in the results."""
    owner: dict[tuple[str, str, int, int], str] = {}
    for p in parameters:
        for place, component in product(places(p.target, model), p.index or (0,)):
            first = owner.setdefault((*place, component), p.name)
            if first != p.name:
                raise StudyError(f"{source}: psi.{p.name}: {p.target} is set by psi.{first} already; allowed: one psi")
    names = {p.name for p in parameters}
    for p in parameters:
        derived = {f"{p.name}_mu", f"{p.name}_sigma"} & names if p.varies == "trajectory" else set()
        if derived:
            raise StudyError(f"{source}: psi.{min(derived)}: psi.{p.name} varies and uses that name; allowed: another")


def _noise(patterns: Mapping[str, float], measured: Sequence[str], names: ModelNames, source: str) -> dict[str, float]:
    """Measured column -> sd. The own name counts most, then the longest pattern, then the later one."""
    columns = list(dict.fromkeys(measured))
    for pattern in patterns:
        if any(column == pattern or fnmatchcase(column, pattern) for column in columns):
            continue
        if not any(fnmatchcase(column, pattern) for column in names.columns):
            raise StudyError(f"{source}: noise.'{pattern}': no column matches; {choices(pattern, columns, limit=20)}")
        warnings.warn(f"{source}: noise.'{pattern}': no recording has such a column", StudyWarning, stacklevel=3)
    resolved = {}
    for column in columns:
        matching = [
            (column == pattern, len(re.sub(r"\[.*?\]|[*?]", "", pattern)), place, sd)
            for place, (pattern, sd) in enumerate(patterns.items())
            if column == pattern or fnmatchcase(column, pattern)
        ]
        if matching:
            resolved[column] = float(max(matching)[-1])
    return resolved


def _known(
    values: Mapping[str, float | list[float]], model: "mujoco.MjModel", names: ModelNames, where: str
) -> dict[Target, Float[np.ndarray, "..."]]:
    """Target -> value in the field's whole shape; one number would not say which component it is."""
    known: dict[Target, np.ndarray] = {}
    for text, given in values.items():
        key = f"{where}.'{text}'"
        target, shape = _resolved(text, model, names, key)
        value = np.array(given, float)
        if value.shape != shape and not (shape == () and value.shape == (1,)):
            allowed = f"a list of {shape[0]} numbers" if shape else "one number"
            raise StudyError(f"{key}: found {given}; allowed: {allowed}")
        check_value(target.kind, target.field, value, key)
        value = value.reshape(shape)
        value.setflags(write=False)
        known[target] = value
    return known
