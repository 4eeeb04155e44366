"""Recorded and predicted motion as poses of bodies: the arrays from which the report replays a recording."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import xarray as xr
from jaxtyping import Float

from det2stoc_bayes.engines.shapes import Shape, moving_bodies, poses, shapes
from det2stoc_bayes.engines.state_columns import state_columns
from det2stoc_bayes.mismatch.heldout import predicted_states
from det2stoc_bayes.mismatch.result import fitted_states
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.simulator import Simulator

MOST_RECORDINGS = 6
MOST_FRAMES = 300
LEAST_FRAMES = 30
MOST_NUMBERS = 400_000  # of all poses together: 1.6 MB
BRIDGED = 5  # median sample intervals over which a missing value is interpolated
LEAST_MOTION = 1e-9  # m or rad: before and after that differ by less are one

type States = Mapping[str, Float[np.ndarray, "samples nq"]]
type Predicted = Callable[[Sequence[str]], Mapping[str, States]]


def replay(simulator: Simulator, rollouts: Mapping[str, xr.Dataset], predicted: Predicted) -> dict[str, xr.Dataset]:
    """Groups of fit.nc: `replay/shapes`, `replay/meshes`, and `replay/motions/<recording>` of at most six recordings.

    `predicted` gives the simulators' states by `before` and `after`, and recording; it is asked only where the recorded
    columns are not all of the positions. Shapes are those of the model's file.
    """
    model = simulator.model
    seen, bodies = shapes(model), moving_bodies(model)
    chosen = _chosen(rollouts)
    if not chosen or not any(shape.body >= 0 for shape in seen):
        return {}
    complete = _complete(simulator, rollouts[chosen[0]])
    states = {} if complete else predicted(chosen)
    if not (complete or states):
        return {}
    frames = int(np.clip(MOST_NUMBERS / (21 * len(bodies) * len(chosen)), LEAST_FRAMES, MOST_FRAMES))
    groups = {}
    for stem in chosen:
        rollout = rollouts[stem]
        at = _frames(rollout.sizes["sample"], frames)
        if complete:
            paths = {which: _positions(simulator, rollout, which) for which in ("observed", "before", "after")}
        else:
            paths = {which: of[stem] for which, of in states.items() if stem in of}
        groups[f"replay/motions/{stem}"] = _motion(simulator, rollout, paths, at)
    names = [model.body(b).name or f"body {b}" for b in bodies]
    return {"replay/shapes": _shapes(seen, names), "replay/meshes": _meshes(seen)} | groups


def states_of(before: Fit, after: Fit, samples: int | None) -> Predicted:
    """The states that two fits predict of fitted and held-out recordings, of these in rollouts of so many samples."""

    def predicted(stems: Sequence[str]) -> Mapping[str, States]:
        study = before.problem.simulator.study
        held = tuple(r for r in study.holdout if r.name in stems)
        fits = {"before": before} | ({} if after is before else {"after": after})
        return {which: fitted_states(fit) | predicted_states(fit, held, samples) for which, fit in fits.items()}

    return predicted


def _chosen(rollouts: Mapping[str, xr.Dataset]) -> list[str]:
    """Held-out recordings first, then those that the believed model predicts worst."""

    def worst(stem: str) -> tuple[bool, float]:
        error = rollouts[stem]["residual_before"].values
        return rollouts[stem].attrs.get("role") != "holdout", -float(np.nanmean(np.append(error**2, 0.0)))

    return [stem for stem in sorted(rollouts, key=worst) if rollouts[stem].sizes["sample"] > 1][:MOST_RECORDINGS]


def _complete(simulator: Simulator, rollout: xr.Dataset) -> bool:
    """Whether the columns are all of the positions."""
    places = state_columns(simulator.model, tuple(map(str, rollout["channel"].values)))
    return all(("qpos", i) in places for i in range(simulator.model.nq))


def _positions(simulator: Simulator, rollout: xr.Dataset, which: str) -> Float[np.ndarray, "samples nq"]:
    """Positions from columns; short gaps of what was recorded are interpolated."""
    places = state_columns(simulator.model, tuple(map(str, rollout["channel"].values)))
    values = rollout[which].transpose("sample", "channel").values
    out = values[:, [places["qpos", i] for i in range(simulator.model.nq)]]
    if which != "observed":
        return out
    time = rollout["time"].values
    return np.stack([_bridged(time, column) for column in out.T], 1)


def _bridged(time: Float[np.ndarray, " samples"], values: Float[np.ndarray, " samples"]) -> np.ndarray:
    """Missing values between neighbours that are close in time, linearly."""
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 2:
        return values
    next_one = np.clip(np.searchsorted(known, np.arange(len(values))), 1, len(known) - 1)
    gap = time[known[next_one]] - time[known[next_one - 1]]
    short = gap <= BRIDGED * np.median(np.diff(time)) * (1 + 1e-6)
    inside = (np.arange(len(values)) >= known[0]) & (np.arange(len(values)) <= known[-1])
    filled = np.interp(time, time[known], values[known])
    return np.where(np.isnan(values) & short & inside, filled, values)


def _frames(num_samples: int, most: int) -> np.ndarray:
    return np.unique(np.round(np.linspace(0, num_samples - 1, min(num_samples, most))).astype(int))


def _motion(simulator: Simulator, rollout: xr.Dataset, paths: States, at: np.ndarray) -> xr.Dataset:
    """Poses (frame, body, 7) by what they are of; nothing that was never there, and `after` only if it differs."""
    found = {which: poses(simulator.model, path[at]) for which, path in paths.items()}
    if "observed" in found:
        found = {"recorded": found.pop("observed")} | found
    if "after" in found and np.allclose(found["before"], found["after"], rtol=0, atol=LEAST_MOTION, equal_nan=True):
        del found["after"]
    there = {which: values.astype(np.float32) for which, values in found.items() if np.isfinite(values).any()}
    variables: dict[str, tuple] = {which: (("frame", "body", "pose"), values) for which, values in there.items()}
    return xr.Dataset(variables, {"time": (("frame",), rollout["time"].values[at])})


def _shapes(seen: Sequence[Shape], names: Sequence[str]) -> xr.Dataset:
    """One row a geom; `of_body` counts the `bodies` that move (-1: the world)."""
    columns = {"size": 3, "position": 3, "quaternion": 4, "colour": 4}
    variables: dict[str, tuple] = {
        name: (("geom", f"{name}_part"), np.array([getattr(s, name) for s in seen]).reshape(-1, width))
        for name, width in columns.items()
    }
    variables["kind"] = (("geom",), [s.kind for s in seen])
    variables["of_body"] = (("geom",), np.array([s.body for s in seen], int))
    variables["num_vertices"] = (("geom",), np.array([len(s.vertices) for s in seen], int))
    variables["num_faces"] = (("geom",), np.array([len(s.faces) for s in seen], int))
    return xr.Dataset(variables, {"bodies": list(names)})


def _meshes(seen: Sequence[Shape]) -> xr.Dataset:
    """The vertices and triangles of all meshes, one after the other."""
    vertices = np.concatenate([s.vertices for s in seen]).astype(np.float32)
    faces = np.concatenate([s.faces for s in seen]).astype(np.int32)
    return xr.Dataset({"vertices": (("vertex", "xyz"), vertices), "faces": (("face", "corner"), faces)})
