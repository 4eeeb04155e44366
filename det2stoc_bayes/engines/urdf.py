"""A URDF as MJCF: MuJoCo's own reader, and what a URDF leaves open (base, actuators) as the user says."""

import tempfile
from pathlib import Path
from xml.etree import ElementTree

from det2stoc_bayes.errors import ModelError

MESHES = (".stl", ".obj", ".msh")  # what MuJoCo loads


def mjcf_of_urdf(
    path: Path,
    *,
    base: str,
    actuators: str,
    mesh_dir: Path | None = None,
) -> tuple[str, dict[str, bytes]]:
    """The MJCF of a URDF, and its meshes by the names under which they lie beside it. Visual shapes are left out.

    `base`: fixed, or free, by a joint named base. `actuators`: none, or motor: one a joint, of its name.
    ModelError: a file that is none, a mesh that is not found (under `mesh_dir` or the URDF's folders) or not read.
    """
    import mujoco

    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise ModelError(f"{path.name}: cannot be read: {error}; allowed: a URDF file") from error
    if root.tag != "robot":
        raise ModelError(f"{path.name}: found <{root.tag}>; allowed: <robot>, as URDF has (xacro is expanded first)")
    meshes = _meshes(path, root, mesh_dir)
    extension = root.find("mujoco")
    extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.attrib.pop("meshdir", None)
    compiler.set("fusestatic", "false" if base == "free" else compiler.get("fusestatic", "true"))
    with tempfile.TemporaryDirectory() as folder:
        for name, content in meshes.items():
            (Path(folder) / name).write_bytes(content)
        file = Path(folder) / path.name
        ElementTree.ElementTree(root).write(file, encoding="utf-8")
        try:
            spec = mujoco.MjSpec.from_file(str(file))
            if base == "free":
                spec.worldbody.first_body().add_freejoint(name="base")
            for joint in spec.joints if actuators == "motor" else ():
                if joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                    spec.add_actuator(name=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)
            spec.compile()
            text = spec.to_xml()
        except (ValueError, AttributeError) as error:
            raise ModelError(f"{path.name}: does not compile: {' '.join(str(error).split())}") from error
    return text, meshes


def _meshes(path: Path, root: ElementTree.Element, mesh_dir: Path | None) -> dict[str, bytes]:
    """The meshes of collision shapes by their bare names, to which the URDF's references are changed in place."""
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    found: dict[str, Path] = {}
    for mesh in root.iter("mesh"):
        given = mesh.get("filename", "")
        bare = Path(given.split("://", 1)[-1])
        if bare.suffix.lower() not in MESHES:
            raise ModelError(f"{path.name}: mesh '{given}': found '{bare.suffix}'; allowed: {', '.join(MESHES)}")
        homes = [mesh_dir] if mesh_dir else [path.parent, *path.resolve().parents[1:3]]
        parts = [Path(*bare.parts[i:]) for i in range(len(bare.parts))]
        file = next((home / part for home in homes for part in parts if (home / part).is_file()), None)
        if file is None:
            raise ModelError(f"{path.name}: mesh '{given}': no such file below {homes[-1]}; give --set mesh-dir=DIR; "
                             "allowed: the folder that holds it")  # fmt: skip
        if found.setdefault(bare.name, file).resolve() != file.resolve():
            raise ModelError(f"{path.name}: two meshes are called {bare.name}; allowed: different names")
        mesh.set("filename", bare.name)
    return {name: file.read_bytes() for name, file in found.items()}
