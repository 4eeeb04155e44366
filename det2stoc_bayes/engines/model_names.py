"""What a compiled MJCF has under which name: columns a recording may hold, fields a target may set."""

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.errors import ModelError
from det2stoc_bayes.suggestions import choices

if TYPE_CHECKING:
    import mujoco  # imported by the functions alone: half a second that a command's --help need not wait

# (kind, prefix of mjModel's array, fields a target may name): what is a continuous parameter, so no types,
# flags, derived constants or colours. A joint's `solref` is its limit's, as in mjModel.
_ARRAYS = (
    ("body", "body_", "mass inertia ipos iquat pos quat gravcomp"),
    ("joint", "jnt_", "stiffness stiffnesspoly range margin solref solimp pos axis actfrcrange"),
    ("joint", "dof_", "damping dampingpoly armature frictionloss"),
    ("geom", "geom_", "friction size pos quat margin gap solref solimp solmix fluid adhesion surfacevel"),
    ("pair", "pair_", "friction solref solreffriction solimp margin gap adhesion"),
    ("actuator", "actuator_", "gainprm biasprm dynprm gear ctrlrange forcerange actrange armature damping"),
    ("actuator", "actuator_", "dampingpoly delay cranklength"),
    ("tendon", "tendon_", "stiffness stiffnesspoly damping dampingpoly frictionloss armature lengthspring"),
    ("tendon", "tendon_", "range margin solref_lim solimp_lim solref_fri solimp_fri actfrcrange"),
    ("opt", "opt.", "gravity wind magnetic density viscosity impratio"),
    ("opt", "opt.", "o_margin o_solref o_solimp o_friction"),
)
KINDS = tuple(dict.fromkeys(kind for kind, _, _ in _ARRAYS))
_FIELDS = {
    kind: {name: prefix + name for k, prefix, names in _ARRAYS for name in names.split() if k == kind} for kind in KINDS
}
# These mjModel calls otherwise; the names are MJCF's.
_FIELDS["joint"] |= {
    "solreffriction": "dof_solref",
    "solimpfriction": "dof_solimp",
    "springref": "qpos_spring",
}
# What a target may not set, and why; where a reason stands, it is the error's.
REFUSED = {
    ("opt", "timestep"): "the samples' times hang on the step, and a diagnosis tries finer ones by itself",
}
_ASIDE = 1e-3  # by which frames are moved apart for compiling; MuJoCo takes less than 1e-6 for nothing
_FREE, _BALL, _SLIDE, _HINGE = range(4)  # mjtJoint, whose members `in` does not find among numpy numbers


@dataclass(frozen=True)
class ModelNames:
    """The names of one compiled model.

    `columns`: all that can be recorded, controls excluded. `actuators`: one a control, "" where unnamed.
    `elements`: the named elements of each kind. `fields`: of each kind, the shape of one element's field.
    `quaternions`: the columns, four each, that are one orientation; of joints and of sensors.
    `hinges`: the position columns of hinge joints with their range, None where unlimited.
    `abrupt`: columns of accelerations and forces, in which one sample may rightly stand alone.
    `free_bodies`: bodies that a free joint moves, with the joint's name.
    """

    columns: tuple[str, ...]
    actuators: tuple[str, ...]
    elements: Mapping[str, tuple[str, ...]]
    fields: Mapping[str, Mapping[str, tuple[int, ...]]]
    quaternions: tuple[tuple[str, ...], ...] = ()
    hinges: Mapping[str, tuple[float, float] | None] = dataclass_field(default_factory=dict)
    abrupt: tuple[str, ...] = ()
    free_bodies: Mapping[str, str] = dataclass_field(default_factory=dict)


def field_of(kind: str, field: str) -> str:
    """mjModel's name of a target's field, as mujoco.batch.Batch.expand takes it: `dof_damping`."""
    if kind not in _FIELDS:
        raise ModelError(f"'{kind}' is no kind of element; {choices(kind, KINDS)}")
    if field not in _FIELDS[kind]:
        raise ModelError(f"{kind}: no field '{field}'; {choices(field, _FIELDS[kind], limit=30)}")
    return _FIELDS[kind][field]


def compile_model(path: Path, folder: Path | None = None) -> "mujoco.MjModel":
    """The compiled MJCF at `path`; neither it nor a file it includes or loads may lie outside of `folder`."""
    import mujoco

    if not path.is_file():
        there = sorted(other.name for other in path.parent.glob("*.xml"))
        allowed = choices(path.name, there) if there else "allowed: the model's MJCF, put there"
        raise ModelError(f"{path.name}: no such file in {path.parent}; {allowed}")
    if path.suffix.lower() != ".xml":
        raise ModelError(f"{path.name}: the model is an MJCF file; allowed: .xml")
    for file in _files_within(path, (folder or path.parent).resolve()):
        if file.suffix.lower() == ".xml":
            _refuse_nan(file)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        said = "; ".join(line for line in str(error).removeprefix("Error: ").splitlines() if line.strip())
        raise ModelError(f"{path.name}: does not compile: {said}") from error
    if not 0 < model.opt.timestep < np.inf:
        raise ModelError(f"{path.name}: option timestep: found {model.opt.timestep:g}; allowed: more than 0 s")
    return model


def _refuse_nan(path: Path) -> None:
    """MuJoCo takes what is not a number, and warns on a screen and in a file of its own."""
    try:
        elements = list(ElementTree.parse(path).iter())
    except (ElementTree.ParseError, ValueError, LookupError):
        return  # MuJoCo's own parser says what is wrong
    for element in elements:
        for name, value in element.attrib.items():
            if name in ("name", "class", "file") or "nan" not in value.lower().split():
                continue
            raise ModelError(f"{path.name}: {element.tag} {name}: found '{value[:60]}'; allowed: finite numbers")


def compile_loose_model(path: Path, folder: Path | None = None) -> "mujoco.MjModel":
    """As `compile_model`, with no shortcut for bodies whose inertial frame is the body's own.

    Such a shortcut makes MuJoCo ignore an inertial frame that is changed later (body_sameframe, body_simple). A model
    that cannot be compiled without it unchanged is returned with it.
    """
    import mujoco

    model = compile_model(path, folder)
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compile()
    for body in spec.bodies[1:]:
        if model.body_sameframe[body.id] and model.body_weldid[body.id] and model.body_mass[body.id] > 0:
            if not body.explicitinertial:
                spec.adopt_inertial(body)
            body.ipos, body.iquat = body.ipos + _ASIDE, body.iquat + _ASIDE * np.array([0.0, 1, 1, 1])
    try:
        loose = spec.compile()
    except ValueError:
        return model
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        getattr(loose, name)[:] = getattr(model, name)
    mujoco.mj_setConst(loose, mujoco.MjData(loose))
    loose.body_sameframe[1:] = 0  # which mj_setConst finds anew
    same = (np.allclose(getattr(loose, n), getattr(model, n), rtol=0, atol=1e-12) for n in ("body_pos", "qpos0"))
    return loose if loose.nq == model.nq and all(same) else model


def _files_within(path: Path, folder: Path) -> Iterator[Path]:
    """The MJCF and every file that it names; raises if one leads out of the folder."""
    waiting, seen = [path], set()
    while waiting:
        current = waiting.pop()
        if current.resolve() in seen:
            continue
        seen.add(current.resolve())
        if not current.resolve().is_relative_to(folder):
            raise ModelError(f"{path.name}: {current} lies outside of the study's folder; allowed: files within it")
        if current.is_file():
            yield current
            if current.suffix.lower() == ".xml":
                waiting += _files_named(current, path.parent)


def model_files(path: Path) -> list[Path]:
    """An MJCF and all that it includes or loads, wherever it lies."""
    path = Path(os.path.abspath(path))  # links are kept: what refers to a file does so by its name
    return sorted({Path(os.path.normpath(file)) for file in _files_within(path, Path(path.anchor))})


def _files_named(xml: Path, main: Path) -> list[Path]:
    """The files an MJCF names, under each directory where MuJoCo might look for them."""
    try:
        root = ElementTree.parse(xml).getroot()
    except (ElementTree.ParseError, ValueError, LookupError):
        return []  # MuJoCo will say what is wrong with it
    attributes = [element.attrib for element in root.iter()]
    directories = {main, xml.parent} | {
        main / a[key] for a in attributes for key in ("meshdir", "texturedir", "assetdir") if key in a
    }
    # MuJoCo's cube textures name six files, and its skins and height fields use `file` like all the rest.
    names = {
        v for a in attributes for k, v in a.items() if re.fullmatch(r"file(|name|up|down|left|right|front|back)", k)
    }
    return [directory / name for directory in directories for name in names if name]


def model_names(model: "mujoco.MjModel") -> ModelNames:
    """What can be recorded from a compiled model, and what a target can name; nothing unnamed."""
    import mujoco
    from mujoco.batch import MODEL_FIELDS  # what this MuJoCo can vary from simulation to simulation

    columns: list[str] = []
    quaternions: list[tuple[str, ...]] = []
    hinges: dict[str, tuple[float, float] | None] = {}
    abrupt: list[str] = []
    free: dict[str, str] = {}
    for joint in map(model.joint, range(model.njnt)):
        if joint.name:
            columns += joint_columns(joint.name, joint.type[0])
            if joint.type[0] in (_FREE, _BALL):
                quaternions.append(tuple(f"qpos/{joint.name}/{part}" for part in ("qw", "qx", "qy", "qz")))
            if joint.type[0] == _FREE:
                free[model.body(int(joint.bodyid[0])).name] = joint.name
            if joint.type[0] == _HINGE:
                limited = model.jnt_limited[joint.id]
                hinges[f"qpos/{joint.name}"] = (float(joint.range[0]), float(joint.range[1])) if limited else None
    for sensor in map(model.sensor, range(model.nsensor)):
        if sensor.name:
            size = int(sensor.dim[0])
            own = [f"sensor/{sensor.name}"] if size == 1 else [f"sensor/{sensor.name}/{i}" for i in range(size)]
            columns += own
            if model.sensor_datatype[sensor.id] == mujoco.mjtDataType.mjDATATYPE_QUATERNION:
                quaternions.append(tuple(own))
            if model.sensor_needstage[sensor.id] == mujoco.mjtStage.mjSTAGE_ACC:
                abrupt += own
    elements = {kind: tuple(name for _, name in _named(model, kind)) for kind in KINDS}
    fields = {
        kind: {f: _shape(model, kind, f) for f, array in known.items() if array in MODEL_FIELDS}
        for kind, known in _FIELDS.items()
    }
    found = (tuple(columns), _controls(model), elements, fields, tuple(quaternions), hinges, tuple(abrupt), free)
    return ModelNames(*found)


def rows_of(model: "mujoco.MjModel", kind: str, name: str, field: str) -> Int[np.ndarray, " rows"]:
    """The rows of `field_of(kind, field)` that a target sets; for `opt` row 0 stands for the option itself.

    `*` is every element of the kind, unnamed ones too, but not the world body. A field of a joint's degrees
    of freedom covers them all; `springref` exists for hinge and slide joints alone.
    """
    array = field_of(kind, field)
    if kind == "opt":
        return np.zeros(1, int)
    first = 1 if kind == "body" else 0
    ids = list(range(first, _count(model, kind))) if name == "*" else [i for i, n in _named(model, kind) if n == name]
    if kind != "joint" or array.startswith("jnt_"):
        return np.array(ids, int)
    if array == "qpos_spring":
        return np.array([model.jnt_qposadr[i] for i in ids if model.jnt_type[i] in (_SLIDE, _HINGE)], int)
    return np.flatnonzero(np.isin(model.dof_jntid, ids))


def believed_value(model: "mujoco.MjModel", kind: str, name: str, field: str) -> Float[np.ndarray, " rows *shape"]:
    """What the MJCF itself says for the rows of a target."""
    array = field_of(kind, field)
    values = [getattr(model.opt, field)] if kind == "opt" else getattr(model, array)[rows_of(model, kind, name, field)]
    return np.array(values, float)


def joint_columns(name: str, kind: Any) -> list[str]:
    """The position and velocity columns of one joint."""
    if kind in (_SLIDE, _HINGE):
        return [f"qpos/{name}", f"qvel/{name}"]
    place, speed = (("x", "y", "z"), ("vx", "vy", "vz")) if kind == _FREE else ((), ())
    positions = [f"qpos/{name}/{part}" for part in (*place, "qw", "qx", "qy", "qz")]
    return positions + [f"qvel/{name}/{part}" for part in (*speed, "wx", "wy", "wz")]


def _count(model: "mujoco.MjModel", kind: str) -> int:
    sizes = {"body": "nbody", "joint": "njnt", "geom": "ngeom", "pair": "npair", "tendon": "ntendon"}
    return len(model.actuator_trntype) if kind == "actuator" else int(getattr(model, sizes[kind]))


def _named(model: "mujoco.MjModel", kind: str) -> Iterator[tuple[int, str]]:
    """Number and name of the named elements of a kind; the world body has nothing to set."""
    if kind == "opt":
        return
    for i in range(1 if kind == "body" else 0, _count(model, kind)):
        name = getattr(model, kind)(i).name
        if name:
            yield i, name


def _controls(model: "mujoco.MjModel") -> tuple[str, ...]:
    """The actuator of every control; "" where it is unnamed, or has several controls and so no column."""
    names = [""] * model.nu
    for i, name in _named(model, "actuator"):
        if model.actuator_ctrlnum[i] == 1:
            names[model.actuator_ctrladr[i]] = name
    return tuple(names)


def _shape(model: "mujoco.MjModel", kind: str, field: str) -> tuple[int, ...]:
    """The shape of one element's field; it does not depend on whether the model has such an element."""
    array = field_of(kind, field)
    return np.shape(getattr(model.opt, field)) if kind == "opt" else getattr(model, array).shape[1:]
