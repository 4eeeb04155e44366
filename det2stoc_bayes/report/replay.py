"""The replay's data for the page: shapes, poses over time, and where to look from."""

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

PARTS = ("recorded", "before", "after")
SMALLEST = 0.03  # of the scene's diameter: bodies that are smaller are drawn larger
ELEVATION, HIGHER = np.radians(16.0), np.radians(28.0)  # of the view, and by how much more over motion in a level plane
ASIDE = np.radians(24.0)  # of the side from which most motion is seen
FACTORS = (1, 3, 10, 30)  # by which differences can be drawn larger
VISIBLE = 0.1  # of a body's extent: a difference that is seen
STILL = 1e-6  # m: what moves less has no way
DIGITS = 5


def scene(fit: xr.DataTree, names: Mapping[str, str], finding: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the browser needs; None where the fit holds no replay."""
    if "replay" not in fit or "motions" not in fit["replay"].children:
        return None
    seen, meshes = (fit[f"replay/{name}"].to_dataset() for name in ("shapes", "meshes"))
    motions = {stem: node.to_dataset() for stem, node in fit["replay/motions"].children.items()}
    motions = {stem: data for stem, data in motions.items() if set(PARTS) & set(data.data_vars)}
    if not motions:
        return None
    sizes = _sizes(seen, meshes)
    poses = np.concatenate([data[part].values for data in motions.values() for part in _parts(data, names)])
    points = _centres(seen, poses.astype(float))
    low, high = _bounds(points, sizes[seen["of_body"].values >= 0])
    radius = max(0.5 * float(np.linalg.norm(high - low)), 1e-3)
    scales = _scales(seen, sizes, radius)
    starts = {stem: _start(seen, data, names, sizes, scales) for stem, data in motions.items()}
    ways = {}
    if finding["where"]["when"]:
        reach = _reaching(seen, sizes)
        ways = {stem: _way(seen, data, fit[f"rollouts/{stem}"].to_dataset(), reach) for stem, data in motions.items()}
    return {
        "shapes": _shapes(seen, meshes),
        "bodies": seen.sizes["bodies"],
        "scales": _numbers(scales),
        "centre": _numbers(0.5 * (low + high)),
        "floor": float(low[2]),
        "radius": float(f"{radius:.{DIGITS}g}"),
        "view": _numbers(_view(points)),
        "motions": {stem: _motion(data, names) | starts[stem] | ways.get(stem, {}) for stem, data in motions.items()},
        "marks": _marks(finding["effects"]),
    }


def enlarged(told: Mapping[str, Any] | None) -> bool:
    """Whether some body is drawn larger than it is."""
    return told is not None and any(scale > 1 for scale in told["scales"])


def traced(told: Mapping[str, Any] | None) -> bool:
    """Whether some motion shows where in space a condition holds."""
    return told is not None and any("way" in motion for motion in told["motions"].values())


def worst(told: Mapping[str, Any] | None) -> dict[str, float]:
    """When [s] the first model is farthest from the recording, of every motion that was recorded."""
    motions = {} if told is None else told["motions"]
    return {stem: motion["worst"] for stem, motion in motions.items() if "worst" in motion}


def _parts(motion: xr.Dataset, names: Mapping[str, str]) -> list[str]:
    """What is shown of a motion: `after` only where the page speaks of it."""
    return [part for part in PARTS if part in motion and (part == "recorded" or part in names)]


def _motion(motion: xr.Dataset, names: Mapping[str, str]) -> dict[str, Any]:
    time = motion["time"].values
    poses = {part: _packed(motion[part].transpose("frame", "body", "pose").values) for part in _parts(motion, names)}
    return {"time": _packed(time - time[0]), "begin": float(time[0]), **poses}


def _start(
    seen: xr.Dataset,
    motion: xr.Dataset,
    names: Mapping[str, str],
    sizes: Float[np.ndarray, " geoms"],
    scales: Float[np.ndarray, " bodies"],
) -> dict[str, Any]:
    """When the first model is farthest from the recording, and the least factor by which that is seen.

    No factor where there is one model only: what it leaves is noise. 1 where no factor shows anything.
    """
    if not {"recorded", "before"} <= set(motion):
        return {}
    recorded, before = (
        motion[part].transpose("frame", "body", "pose").values.astype(float) for part in ("recorded", "before")
    )
    moving = seen["of_body"].values >= 0
    of_body = seen["of_body"].values[moving]
    half = np.arccos(np.clip(np.abs((recorded[..., 3:] * before[..., 3:]).sum(-1)), 0.0, 1.0))[:, of_body]
    turned = np.where(seen["kind"].values[moving] == "sphere", 0.0, 2 * half)  # a sphere looks the same
    apart = np.linalg.norm(_centres(seen, before) - _centres(seen, recorded), axis=2) + sizes[moving] * turned
    most = np.nan_to_num(apart / (_extents(seen, sizes) * scales)[of_body], posinf=0.0).max(1)
    found = {"worst": float(motion["time"].values[most.argmax()])}
    if "after" not in names:
        return found
    return found | {"factor": next((f for f in FACTORS if f * most.max() >= VISIBLE), 1)}


def _extents(seen: xr.Dataset, sizes: Float[np.ndarray, " geoms"]) -> Float[np.ndarray, " bodies"]:
    """The largest side [m] of a box about the shapes of each body."""
    of_body, position = seen["of_body"].values, seen["position"].values
    found = np.full(seen.sizes["bodies"], np.inf)  # of a body without shapes, of which nothing is seen
    for body in np.unique(of_body[of_body >= 0]):
        here, size = position[of_body == body], sizes[of_body == body, None]
        found[body] = max(float(((here + size).max(0) - (here - size).min(0)).max()), 1e-12)
    return found


def _reaching(seen: xr.Dataset, sizes: Float[np.ndarray, " geoms"]) -> list[int]:
    """The largest shape of every body that moves, counted among the shapes that do."""
    of_body = seen["of_body"].values
    moving = np.flatnonzero(of_body >= 0)
    return [
        max(np.flatnonzero(of_body[moving] == body).tolist(), key=lambda k: sizes[moving[k]])
        for body in np.unique(of_body[moving])
    ]


def _way(seen: xr.Dataset, motion: xr.Dataset, rollout: xr.Dataset, reach: list[int]) -> dict[str, Any]:
    """Centres (frames, bodies, 3) of these shapes where they move, and in which frames the condition holds."""
    if "condition" not in rollout or not rollout["condition"].values.any():
        return {}
    poses = motion[next(part for part in PARTS if part in motion)].transpose("frame", "body", "pose").values
    centres = _centres(seen, poses.astype(float))[:, reach]
    times = rollout["time"].values
    nearest = np.abs(times[:, None] - motion["time"].values).argmin(0)
    there = np.where(np.isfinite(centres), centres, np.nan_to_num(centres[:1]))
    moves = np.ptp(there, axis=0).max(1) > STILL
    acts = "".join("1" if held else "0" for held in rollout["condition"].values[nearest])
    return {"way": _packed(centres[:, moves]), "acts": acts}


def _marks(effects: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Places in space among the parameters of named effects; with a normal where they are the edge of a region."""
    found = []
    for parameters in (effect["parameters"] for effect in effects):
        at = next((parameters[name]["mean"] for name in ("point", "anchor", "centre") if name in parameters), None)
        normal = parameters["normal"]["mean"] if "normal" in parameters else None
        if at is not None and None not in (*at, *(normal or ())):
            found.append({"at": _numbers(at), "normal": normal and _numbers(normal)})
    return found


def _shapes(seen: xr.Dataset, meshes: xr.Dataset) -> list[dict[str, Any]]:
    found, vertex, face = [], 0, 0
    for k in range(seen.sizes["geom"]):
        one = {name: _numbers(seen[name].values[k]) for name in ("size", "position", "quaternion", "colour")}
        one |= {"kind": str(seen["kind"].values[k]), "body": int(seen["of_body"].values[k])}
        num_vertices, num_faces = int(seen["num_vertices"].values[k]), int(seen["num_faces"].values[k])
        if num_faces:
            one["vertices"] = _packed(meshes["vertices"].values[vertex : vertex + num_vertices])
            one["faces"] = _packed(meshes["faces"].values[face : face + num_faces], "<u4")
        vertex, face = vertex + num_vertices, face + num_faces
        found.append(one)
    return found


def _sizes(seen: xr.Dataset, meshes: xr.Dataset) -> Float[np.ndarray, " geoms"]:
    """Radius of a sphere about each shape [m]."""
    sizes, vertex = [], 0
    for k in range(seen.sizes["geom"]):
        count = int(seen["num_vertices"].values[k])
        vertices = meshes["vertices"].values[vertex : vertex + count]
        own = (
            np.linalg.norm(vertices, axis=1).max()
            if count
            else _radius(str(seen["kind"].values[k]), seen["size"].values[k])
        )
        sizes.append(float(own))
        vertex += count
    return np.array(sizes)


def _scales(seen: xr.Dataset, sizes: Float[np.ndarray, " geoms"], radius: float) -> Float[np.ndarray, " bodies"]:
    """How many times larger each body is drawn, so that none is too small to be seen."""
    reach = np.zeros(seen.sizes["bodies"])
    for body, position, size in zip(seen["of_body"].values, seen["position"].values, sizes, strict=True):
        if body >= 0:
            reach[body] = max(reach[body], float(np.linalg.norm(position)) + size)
    scales = np.maximum(1.0, SMALLEST * radius / np.maximum(reach, 1e-12))
    return np.where((scales > 1.05) & (reach > 0), scales, 1.0)


def _centres(seen: xr.Dataset, poses: Float[np.ndarray, "frames bodies 7"]) -> Float[np.ndarray, "frames geoms 3"]:
    """Where the shapes of moving bodies are."""
    of_body = seen["of_body"].values
    moving = poses[:, of_body[of_body >= 0]]
    offset = np.broadcast_to(seen["position"].values[of_body >= 0], (*moving.shape[:2], 3))
    w, v = moving[..., 3:4], moving[..., 4:]
    turned = offset + 2 * np.cross(v, np.cross(v, offset) + w * offset)
    return moving[..., :3] + turned


def _radius(kind: str, size: np.ndarray) -> float:
    """Of a sphere about a geom."""
    if kind == "sphere":
        return float(size[0])
    if kind == "capsule":
        return float(size[0] + size[1])
    return float(np.linalg.norm(size[:2] if kind in ("cylinder", "plane") else size))


def _bounds(points: Float[np.ndarray, "frames geoms 3"], sizes: Float[np.ndarray, " geoms"]) -> np.ndarray:
    """Lowest and highest corner (2, 3) of what moves, shapes included; far excursions of a few frames aside."""
    corners = []
    for shape, size in enumerate(sizes):
        there = points[np.isfinite(points[:, shape]).all(1), shape]
        if len(there):
            low, high = np.quantile(there, [0.005, 0.995], axis=0)
            corners += [low - size, high + size]
    return np.array([np.min(corners, axis=0), np.max(corners, axis=0)])


def _view(points: np.ndarray) -> Float[np.ndarray, "3"]:
    """Unit vector towards the eye: somewhat above and aside of the horizontal direction along which least moves."""
    spread = np.zeros((2, 2))
    for shape in range(points.shape[1]):
        flat = points[:, shape, :2]
        flat = flat[np.isfinite(flat).all(1)]
        spread += np.cov(flat, rowvar=False) if len(flat) > 1 else 0.0
    values, vectors = np.linalg.eigh(spread)
    least = vectors[:, 0] * (-1.0 if vectors[1, 0] > 0 else 1.0)  # from the front, which mostly is -y
    if values[1] < 1e-12:  # nothing moves sideways
        least = np.array([0.0, -1.0])
    turn = np.array([[np.cos(ASIDE), -np.sin(ASIDE)], [np.sin(ASIDE), np.cos(ASIDE)]])
    level = np.sqrt(max(values[0], 0.0) / values[1]) if values[1] > 1e-12 else 0.0
    rise = ELEVATION + HIGHER * level
    return np.append(np.cos(rise) * (turn @ least), np.sin(rise))


def _packed(values: np.ndarray, dtype: str = "<f4") -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode("ascii")


def _numbers(values: np.ndarray | Sequence[float]) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in np.asarray(values, float)]
