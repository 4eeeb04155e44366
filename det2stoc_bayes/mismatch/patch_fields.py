"""Model fields into MJCF: a spec's text with chosen fields changed, and the check that nothing else did."""

import ctypes
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Bool
from mujoco.batch import MODEL_FIELDS

from det2stoc_bayes.errors import ModelError

Place = tuple[str, int | None]  # a field of mjModel and a row of it; None for a whole field of opt
RELATIVE, ABSOLUTE = 1e-9, 1e-12  # numbers that differ by less are the same
_DIGITS = 17  # the text of a double that reads back as itself
_INERTIAL = ("body_mass", "body_inertia", "body_ipos", "body_iquat")
_SHAPE = ("geom_size", "geom_pos", "geom_quat")  # a body's inertia follows them unless it is explicit
# What the compiler works out from other fields: sizes of sparse matrices, trees, constants at qpos0.
_DERIVED = re.compile(
    r"(B|D|M|map|efm|bvh|flexedge|ten_J|tree)\w*_?.*|.*(invweight0|sameframe|_aabb|rbound|simple|simplenum|bvhadr|bvhnum)"
    r"|body_(subtreemass|margin)|dof_(M0|length|Madr)|actuator_(acc0|length0|lengthrange)|tendon_length0|(cam|light)_\w+0"
    r"|(jnt|tendon)_actuatorid|name_\w+adr|names_map"
)
_ASSETS = ("meshes", "hfields", "skins", "textures")


def read_field(model: mujoco.MjModel, name: str) -> np.ndarray:
    """A field by its name in `mujoco.batch`, as `dof_damping` or `opt.gravity`."""
    return np.asarray(getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name))


def write_field(model: mujoco.MjModel, name: str, value: np.ndarray) -> None:
    """Sets a whole field."""
    if name.startswith("opt."):
        setattr(model.opt, name[4:], value if np.ndim(value) else np.asarray(value).item())
    else:
        getattr(model, name)[:] = value


def differences(
    wanted: mujoco.MjModel, other: mujoco.MjModel, derived: bool = False
) -> dict[str, Bool[np.ndarray, "..."]]:
    """Fields in which two models differ, with the components that do; ModelError if names or sizes differ."""
    for size in (
        "nq",
        "nv",
        "nu",
        "na",
        "nbody",
        "njnt",
        "ngeom",
        "nsensor",
        "ntendon",
        "neq",
        "npair",
        "names",
    ):
        if getattr(wanted, size) != getattr(other, size):
            found = f"{getattr(other, size)!r:.60} for {getattr(wanted, size)!r:.60}"
            raise ModelError(f"patched.xml: does not read back as the model it is from: {size} is {found}")
    out = {}
    for name in sorted(MODEL_FIELDS):
        if not derived and _DERIVED.fullmatch(name):
            continue
        a, b = read_field(wanted, name), read_field(other, name)
        if a.shape != b.shape:
            raise ModelError(f"patched.xml: {name} reads back with shape {b.shape} for {a.shape}")
        if a.dtype.kind in "fiub":
            near = np.isclose(b.astype(float), a.astype(float), rtol=RELATIVE, atol=ABSOLUTE, equal_nan=True)
            where = np.asarray(~near)
            if where.any():
                out[name] = where
    return out


def mjcf_text(path: Path, root: Path, wanted: mujoco.MjModel) -> tuple[str, mujoco.MjModel]:
    """The MJCF at `path` with the fields of `wanted`, as far as MJCF can say them, and what it compiles to.

    Files that it names are given relative to `root`, where the text is to be read.
    """
    spec = _spec(path, root)
    changed = differences(wanted, spec.compile())
    for body in _explicit(wanted, changed):
        spec.adopt_inertial(_body(spec, wanted, body))
    for body in _rows(changed.get("body_gravcomp", np.zeros(0, bool))):
        _body(spec, wanted, body).gravcomp = float(wanted.body_gravcomp[body])
    if "opt.integrator" in changed:
        spec.option.integrator = wanted.opt.integrator
    with _all_digits():
        text = _written(spec.to_xml(), root, wanted, [p for f, where in changed.items() for p in _places(f, where)])
    return _shortest(text), _load(_shortest(text), root).compile()


def asset_files(path: Path, root: Path) -> list[Path]:
    """Files that the compiled MJCF needs beside its text: meshes, textures, height fields, skins."""
    spec = _spec(path, root)
    return sorted({root / name for item in _items(spec) for name in _names(item)})


def _places(field: str, where: Bool[np.ndarray, "..."]) -> list[Place]:
    if field.startswith("opt."):
        return [(field, None)]
    return [(field, row) for row in _rows(where)]


def _rows(where: Bool[np.ndarray, "..."]) -> list[int]:
    return [int(row) for row in np.unique(np.nonzero(where)[0])]


def _explicit(wanted: mujoco.MjModel, changed: Mapping[str, np.ndarray]) -> list[int]:
    """Bodies whose inertia must be explicit, for it to stay or to be set by itself."""
    bodies = {row for f in _INERTIAL if f in changed for row in _rows(changed[f])}
    geoms = [row for f in _SHAPE if f in changed for row in _rows(changed[f])]
    return sorted((bodies | {int(wanted.geom_bodyid[g]) for g in geoms}) - {0})


def _body(spec: mujoco.MjSpec, model: mujoco.MjModel, body: int) -> mujoco.MjsBody:
    name = model.body(body).name
    return spec.body(name) if name else next(b for b in spec.bodies if b.id == body)


def _written(text: str, root: Path, wanted: mujoco.MjModel, places: Sequence[Place]) -> str:
    """The text with as many of the places as can be written: all at once, or else by halves."""
    if not places:
        return text
    try:
        return _attempt(text, root, wanted, places)
    except (ValueError, mujoco.FatalError):
        fields = list(dict.fromkeys(f for f, _ in places))
        if len(places) == 1:
            return text
        if len(fields) > 1:
            first = set(fields[: len(fields) // 2])
            parts = [p for p in places if p[0] in first], [p for p in places if p[0] not in first]
        else:
            parts = places[: len(places) // 2], places[len(places) // 2 :]
        return _written(_written(text, root, wanted, parts[0]), root, wanted, parts[1])


def _attempt(text: str, root: Path, wanted: mujoco.MjModel, places: Sequence[Place]) -> str:
    spec = _load(text, root)
    model = spec.compile()
    for field, row in places:
        if row is None:
            write_field(model, field, read_field(wanted, field))
        else:
            getattr(model, field)[row] = getattr(wanted, field)[row]
    spec.copy_back(model)
    text = spec.to_xml()
    _load(text, root).compile()
    return text


def _spec(path: Path, root: Path) -> mujoco.MjSpec:
    """The spec of a file, whose own files are named relative to `root`."""
    spec = mujoco.MjSpec.from_file(str(path))
    for item in _items(spec):
        directory = spec.texturedir if isinstance(item, mujoco.MjsTexture) else spec.meshdir

        def moved(name: str, directory: str = directory) -> str:
            kept = Path(name).name if spec.strippath else name
            return os.path.relpath((path.parent / directory / kept).resolve(), root.resolve()).replace(os.sep, "/")

        if item.file:
            item.file = moved(item.file)
        for k, name in enumerate(getattr(item, "cubefiles", ())):
            if name:
                item.cubefiles[k] = moved(name)
    for holder in (spec, spec.compiler):
        holder.meshdir = holder.texturedir = ""
    spec.strippath = False
    spec.modelfiledir = str(root)
    return spec


def _load(text: str, root: Path) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(text)
    spec.modelfiledir = str(root)
    return spec


def _items(spec: mujoco.MjSpec) -> list:
    return [item for kind in _ASSETS for item in getattr(spec, kind) if any(_names(item))]


def _names(item) -> list[str]:
    return [name for name in (item.file, *getattr(item, "cubefiles", ())) if name]


@contextmanager
def _all_digits() -> Iterator[None]:
    """Lets MuJoCo write numbers in full; without it they have six digits.

    The switch is not part of MuJoCo's interface. Where it is missing, what is lost shows in `differences`.
    """
    library = next(iter(sorted(Path(mujoco.__file__).parent.glob("*mujoco.[sd]*"))), None)
    try:
        handle = ctypes.CDLL(str(library))
        read, switch = handle._mjPRIVATE__get_xml_precision, handle._mjPRIVATE__set_xml_precision
    except (OSError, AttributeError):
        yield
        return
    before = read()
    switch(_DIGITS)
    try:
        yield
    finally:
        switch(before)


def _shortest(text: str) -> str:
    """Each number in the fewest digits that read back as it: 0.1 for 0.10000000000000001."""
    return re.sub(r"(?<![\w.])-?\d+\.\d{12,}(?:e[-+]?\d+)?(?![\w.])", lambda m: repr(float(m[0])), text)
