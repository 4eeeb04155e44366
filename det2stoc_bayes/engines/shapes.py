"""What a model looks like, and where its bodies are in states by the thousand: for replays without MuJoCo."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from det2stoc_bayes.engines.rotations import product

HIDDEN = 3  # the group from which on MuJoCo's viewers hide geoms
MOST_FACES = 1500  # of a mesh; a finer one is replaced by its hull, and that by its box
MOST_CELLS = 40  # of a height field's side
GREY = (0.6, 0.6, 0.6, 1.0)
KINDS = {
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}
NAMES = {int(kind): name for name, kind in KINDS.items()}
_HFIELD, _MESH, _SDF = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{n}")) for n in ("HFIELD", "MESH", "SDF"))


@dataclass(frozen=True, eq=False)
class Shape:
    """A geom: `size` as MuJoCo has it [m], its place in the frame of `body` (-1: the world), and rgba.

    A `mesh` has vertices in its own frame, and triangles.
    """

    kind: str
    body: int
    size: Float[np.ndarray, "3"]
    position: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]
    colour: Float[np.ndarray, "4"]
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]


def moving_bodies(model: mujoco.MjModel) -> list[int]:
    """The bodies that can move by themselves; others are welded to one of them, or to the world."""
    return [b for b in range(1, model.nbody) if model.body_weldid[b] == b]


def shapes(model: mujoco.MjModel) -> list[Shape]:
    """All that is to be seen; a moving body without any geom is the box that has its inertia."""
    bodies, data = moving_bodies(model), mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    number = {0: -1} | {body: k for k, body in enumerate(bodies)}
    found = []
    for g in _visible(model):
        kind, vertices, faces = _form(model, g)
        if kind:
            root = int(model.body_weldid[model.geom_bodyid[g]])
            place = _relative(data, root, data.geom_xpos[g], _quaternion(data.geom_xmat[g]))
            found.append(
                Shape(kind, number[root], model.geom_size[g].copy(), *place, _colour(model, g), vertices, faces)
            )
    seen = {shape.body for shape in found}
    for b in range(1, model.nbody):
        root = int(model.body_weldid[b])
        if root and number[root] not in seen and model.body_mass[b] > 0:
            place = _relative(data, root, data.xipos[b], _quaternion(data.ximat[b]))
            found.append(Shape("box", number[root], _inertia_box(model, b), *place, np.array(GREY), *_no_mesh()))
    return found


def poses(model: mujoco.MjModel, qpos: Float[np.ndarray, "samples nq"]) -> Float[np.ndarray, "samples bodies 7"]:
    """Position [m] and quaternion of every moving body; NaN where a coordinate is."""
    bodies, data = moving_bodies(model), mujoco.MjData(model)
    out = np.full((len(qpos), len(bodies), 7), np.nan)
    for k in np.flatnonzero(np.isfinite(qpos).all(1)):
        data.qpos[:] = qpos[k]
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        out[k, :, :3], out[k, :, 3:] = data.xpos[bodies], data.xquat[bodies]
    return out


def _visible(model: mujoco.MjModel) -> list[int]:
    """Geoms in the groups that viewers show, or all where that is none."""
    shown = [g for g in range(model.ngeom) if _colour(model, g)[3] > 0]
    return [g for g in shown if model.geom_group[g] < HIDDEN] or shown


def _colour(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "4"]:
    material = int(model.geom_matid[geom])
    return np.array(model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom], float)


def _form(model: mujoco.MjModel, geom: int) -> tuple[str, np.ndarray, np.ndarray]:
    kind, data = int(model.geom_type[geom]), int(model.geom_dataid[geom])
    if kind in NAMES:
        return NAMES[kind], *_no_mesh()
    if kind == _HFIELD:
        return "mesh", *_height_field(model, data)
    if kind in (_MESH, _SDF) and data >= 0:
        return "mesh", *_simple(*_mesh(model, data))
    return "", *_no_mesh()


def _no_mesh() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((0, 3)), np.zeros((0, 3), int)


def _mesh(model: mujoco.MjModel, number: int) -> tuple[np.ndarray, np.ndarray]:
    first, count = int(model.mesh_vertadr[number]), int(model.mesh_vertnum[number])
    begin, faces = int(model.mesh_faceadr[number]), int(model.mesh_facenum[number])
    return np.array(model.mesh_vert[first : first + count], float), np.array(
        model.mesh_face[begin : begin + faces], int
    )


def _simple(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of few faces as it is, else its convex hull, else its box."""
    if len(faces) <= MOST_FACES:
        return vertices, faces
    low, high = vertices.min(0), vertices.max(0)
    corners = np.array(np.meshgrid(*np.stack([low, high], 1), indexing="ij")).reshape(3, 8).T
    for points in (vertices, corners):
        try:
            hull = ConvexHull(points)
        except QhullError:  # flat
            continue
        if len(hull.simplices) <= MOST_FACES:
            used, renamed = np.unique(hull.simplices, return_inverse=True)
            return points[used], _outward(points[used], renamed.reshape(-1, 3))
    return vertices, faces[:: -(-len(faces) // MOST_FACES)]


def _outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Triangles of a convex body, counterclockwise as seen from outside."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * (a - vertices.mean(0))).sum(1) < 0
    return np.where(inward[:, None], faces[:, ::-1], faces)


def _height_field(model: mujoco.MjModel, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Its surface, thinned to at most MOST_CELLS cells a side."""
    rows, columns = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
    first, (x, y, height, _) = int(model.hfield_adr[number]), model.hfield_size[number]
    level = model.hfield_data[first : first + rows * columns].reshape(rows, columns) * height
    i, j = (np.unique(np.linspace(0, n - 1, min(n, MOST_CELLS + 1)).astype(int)) for n in (rows, columns))
    along, across = np.linspace(-x, x, columns)[j], np.linspace(-y, y, rows)[i]
    wide, deep = np.meshgrid(along, across)
    vertices = np.stack([wide, deep, level[np.ix_(i, j)]], -1).reshape(-1, 3)
    corner = (np.arange(len(i) - 1)[:, None] * len(j) + np.arange(len(j) - 1)).reshape(-1, 1)
    lower, upper = corner + np.array([0, 1, len(j) + 1]), corner + np.array([0, len(j) + 1, len(j)])
    return vertices.astype(float), np.concatenate([lower, upper])


def _inertia_box(model: mujoco.MjModel, body: int) -> Float[np.ndarray, "3"]:
    """Half sides of the box of even density that has the body's mass and inertia."""
    moments = model.body_inertia[body]
    squares = 1.5 * (moments.sum() - 2 * moments) / model.body_mass[body]
    return np.sqrt(np.maximum(squares, 1e-12))


def _relative(
    data: mujoco.MjData, root: int, position: np.ndarray, quaternion: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A place in the world as one in a body's frame."""
    turn = data.xmat[root].reshape(3, 3)
    back = data.xquat[root] * np.array([1.0, -1, -1, -1])
    return turn.T @ (position - data.xpos[root]), product(back, quaternion)


def _quaternion(matrix: np.ndarray) -> Float[np.ndarray, "4"]:
    out = np.empty(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(matrix, float).reshape(9))
    return out
