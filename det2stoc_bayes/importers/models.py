"""The model of an imported study: an MJCF with all that it loads, or a URDF that becomes one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os.path import abspath, commonpath
from pathlib import Path

from det2stoc_bayes.engines.model_names import model_files
from det2stoc_bayes.engines.urdf import mjcf_of_urdf
from det2stoc_bayes.importers.base import Asked, SourceError

SETTINGS = {
    "base": "of a URDF: fixed (to the world) or free",
    "actuators": "of a URDF: none, or motor (one a joint, of its name)",
    "mesh-dir": "of a URDF: where its meshes lie",
}


@dataclass(frozen=True)
class ModelFiles:
    """A model as files of a study: `main` is its MJCF, `notes` what is told of it."""

    main: str
    files: Mapping[str, bytes]
    notes: Sequence[str]


def read_model(path: Path, asked: Asked) -> ModelFiles:
    """The files of --model; SourceError for what is neither MJCF nor URDF."""
    if not path.is_file():
        raise SourceError(f"--model {path}: no such file; allowed: an MJCF (.xml) or a URDF (.urdf)")
    suffix = path.suffix.lower()
    if suffix not in (".xml", ".urdf"):
        raise SourceError(f"--model {path}: found a '{path.suffix}' file; allowed: .xml (MJCF) or .urdf")
    return _urdf(path, asked) if suffix == ".urdf" else _mjcf(path)


def _mjcf(path: Path) -> ModelFiles:
    """An MJCF as model.xml, the rest as it lies about it; all below model/ where something lies elsewhere."""
    path = Path(abspath(path))
    there = model_files(path)
    root = Path(commonpath([path.parent, *(file.parent for file in there)]))
    names = {file: file.relative_to(root).as_posix() for file in there}
    if root == path.parent and (path.parent / "model.xml" not in names or path.name == "model.xml"):
        names[path] = "model.xml"
    elif root != path.parent:
        names = {file: f"model/{name}" for file, name in names.items()}
    notes = [f"{path.name} as it is" + (f", with {len(there) - 1} files that it loads" if len(there) > 1 else "")]
    return ModelFiles(names[path], {name: file.read_bytes() for file, name in names.items()}, notes)


def _urdf(path: Path, asked: Asked) -> ModelFiles:
    """A URDF says neither how its base stands nor what drives its joints."""
    base = asked.setting("base", ("fixed", "free"), f"{path.name}: how the base stands")
    actuators = asked.setting("actuators", ("none", "motor"), f"{path.name}: what drives the joints")
    homes = {"mesh_dir": Path(asked.settings["mesh-dir"])} if "mesh-dir" in asked.settings else {}
    text, meshes = mjcf_of_urdf(path, base=base, actuators=actuators, **homes)
    notes = [
        f"{path.name}, turned into MJCF by MuJoCo: base {base}, actuators {actuators}, visual shapes left out",
        "a URDF has neither time step nor gravity: MuJoCo's 0.002 s and -9.81 m/s^2 along z stand in model.xml",
    ]
    return ModelFiles("model.xml", {"model.xml": text.encode(), **meshes}, notes)
