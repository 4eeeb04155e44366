"""The corrected simulator: patched.xml with all that MJCF can say, effects.py with the rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from det2stoc_bayes.engines.model_names import compile_model
from det2stoc_bayes.errors import ModelError
from det2stoc_bayes.mismatch.effects.base import PlacedEffect
from det2stoc_bayes.mismatch.patch_fields import asset_files, differences, mjcf_text, read_field, write_field
from det2stoc_bayes.mismatch.patch_module import CLOCK, FieldWrite, Values, hooks_of, module_text, parameter_texts
from det2stoc_bayes.simulator import address
from det2stoc_bayes.study import Study
from det2stoc_bayes.suggestions import choices

Effects = Sequence[tuple[PlacedEffect, Values]]


@dataclass(frozen=True)
class Patch:
    """Texts of patched.xml and of effects.py (None where nothing needs it), and the files to lie beside them.

    `assets`: path relative to patched.xml -> file. `unsaid`: fields of the model that MJCF cannot say.
    """

    model: str
    module: str | None
    assets: Mapping[str, Path]
    unsaid: tuple[str, ...] = ()


def make_patch(
    study: Study,
    psi: Mapping[str, float],
    effects: Effects = (),
    *,
    timestep: float | None = None,
    integrator: str | None = None,
) -> Patch:
    """The believed model with these parameters and effects. Fields under [known] stay as in the model's file.

    `psi`: a value for every parameter; the population mean of one that varies.
    """
    clocks = [e for e in effects if CLOCK in e[0].effect.changes]  # steps are to be those of the recorded clock
    plain = [e for e in effects if CLOCK not in e[0].effect.changes]
    wanted = wanted_model(study, psi, plain, timestep=timestep, integrator=integrator)
    text, reloaded = mjcf_text(study.model_path, study.folder, wanted)
    for placed, given in clocks:
        _write_effect(wanted, placed, given)
    fields = [_field_write(wanted, name, where) for name, where in differences(wanted, reloaded).items()]
    comment = _comment(study, psi, effects, fields)
    files = {p.relative_to(study.folder).as_posix(): p for p in assets(study)}
    return Patch(f"{comment}\n{text.lstrip()}", module_text(effects, fields), files, tuple(f.field for f in fields))


def assets(study: Study) -> list[Path]:
    """Meshes, textures, height fields and skins; beside patched.xml they lie as in the study's folder.

    Included MJCF files are part of patched.xml's text.
    """
    return asset_files(study.model_path, study.folder)


def wanted_model(
    study: Study,
    psi: Mapping[str, float],
    effects: Effects = (),
    *,
    timestep: float | None = None,
    integrator: str | None = None,
) -> mujoco.MjModel:
    """The believed model with the fields of psi and of the effects; what derives from them is as it was."""
    model = compile_model(study.model_path)
    names = [p.name for p in study.parameters]
    for name in sorted(set(names) ^ set(psi)):
        found = "no value" if name in names else "no such parameter"
        raise ModelError(f"patched.xml: psi.{name}: {found}; a value for each is needed; {choices(name, names, 20)}")
    for parameter in study.parameters:
        where = address(model, parameter.target, parameter.index)
        values = np.array(read_field(model, where.field), dtype=float)
        for place in where.places:
            if (parameter.target.kind, place[:1]) != ("body", (0,)):  # the world has nothing to set
                values[place] = psi[parameter.name]
        write_field(model, where.field, values)
    for placed, given in effects:
        _write_effect(model, placed, given)
        if placed.element.kind == "simulator":
            timestep = float(np.asarray(given["timestep"])) if timestep is None else timestep
            integrator = str(given["integrator"]) if "integrator" in given else integrator
    model.opt.timestep = model.opt.timestep if timestep is None else timestep
    if integrator is not None:
        model.opt.integrator = mujoco.mjtIntegrator.__members__[f"mjINT_{integrator.upper()}"]
    return model


def _write_effect(model: mujoco.MjModel, placed: PlacedEffect, given: Values) -> None:
    """Fields as an effect changes them; its hook has the simulations' axis first."""
    if placed.effect.changes:
        fields = {name: np.array(read_field(model, name), dtype=float)[None] for name in placed.effect.changes}
        parameters = {name: np.asarray(value, dtype=float)[None] for name, value in given.items()}
        for name, value in placed.effect.fields(parameters, fields, placed.element, np).items():
            write_field(model, name, np.asarray(value[0]))


def _field_write(model: mujoco.MjModel, name: str, where: np.ndarray) -> FieldWrite:
    if name.startswith("opt."):
        return FieldWrite(name, (), read_field(model, name).tolist())
    rows = tuple(int(row) for row in np.unique(np.nonzero(where)[0]))
    return FieldWrite(name, rows, read_field(model, name)[list(rows)].tolist())


def _comment(study: Study, psi: Mapping[str, float], effects: Effects, fields: Sequence[FieldWrite]) -> str:
    """What the file is and what was changed."""
    lines = [f"{study.name}: the corrected model, for MuJoCo {mujoco.__version__}"]
    lines += [f"{p.name} = {psi[p.name]:.6g} ({p.target})" for p in study.parameters]
    for placed, given in effects:
        values = ", ".join(parameter_texts(placed, given))
        inside = "in effects.py" if hooks_of(placed.effect) else "in this file"
        lines.append(f"{placed.label}: {placed.effect.law_text}; {values}; {inside}")
    if fields:
        lines.append(f"in effects.py, since MJCF cannot express them: {', '.join(f.field for f in fields)}")
    text = "\n".join(f"  {line}" for line in lines)
    while "--" in text:
        text = text.replace("--", "- -")
    return f"<!--\n{text}\n-->"
