"""First guesses of the states from which segments start, and how far they may be off."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.engines.layout import column_address
from det2stoc_bayes.segments import Segments

if TYPE_CHECKING:
    import mujoco

NUM_NEAR = 9  # samples of the local fit


@dataclass(frozen=True)
class StartGuess:
    """A start for each segment, and the sd of a wide prior about it, in tangent coordinates (positions, velocities)."""

    start: Start
    prior_sd: Float[np.ndarray, "segments states"]
    scale: Float[np.ndarray, " states"]  # typical magnitude of each coordinate's variation


def guess_starts(model: "mujoco.MjModel", segments: Segments) -> StartGuess:
    """Recorded values where there are any, slopes of a local quadratic for velocities that were not recorded.

    The prior is three times as wide as the coordinate's own variation, so that the samples decide.
    """
    qpos = np.tile(model.qpos0, (segments.count, 1))
    qvel = np.zeros((segments.count, model.nv))
    scale = np.ones(2 * model.nv)
    slopes: dict[int, np.ndarray] = {}  # by index into qpos
    speeds: dict[int, np.ndarray] = {}  # by index into qvel
    for j, column in enumerate(segments.columns):
        where = column_address(model, column)
        level, slope = _local_fit(segments.time, segments.values[:, :, j])
        seen = np.isfinite(level)  # where the column was not recorded, the model's own value stays
        if where.source == "qpos":
            qpos[seen, where.index] = level[seen]
            slopes[where.index] = np.nan_to_num(slope)
        elif where.source == "qvel":
            speeds[where.index] = level
    qvel[:] = _speeds(model, speeds, slopes)
    for joint in range(model.njnt):
        _joint_scales(model, joint, segments, scale)
    _normalise_quaternions(model, qpos)
    act = np.zeros((segments.count, model.na))
    return StartGuess(Start(qpos, qvel, act), np.tile(3 * scale, (segments.count, 1)), scale)


def _speeds(model, speeds: dict[int, np.ndarray], slopes: dict[int, np.ndarray]) -> np.ndarray:
    """Recorded velocities; where a segment has none, slopes of straight coordinates, else 0 (segments, nv)."""
    count = max((len(x) for x in (*speeds.values(), *slopes.values())), default=1)
    out = np.zeros((count, model.nv))
    for joint in range(model.njnt):
        kind, q, v = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        for k in range({0: 6, 1: 3}.get(kind, 1)):
            straight = kind in (2, 3) or (kind == 0 and k < 3)
            fallback = slopes.get(q + k, 0.0) if straight else 0.0
            recorded = speeds.get(v + k, np.full(count, np.nan))
            out[:, v + k] = np.where(np.isfinite(recorded), recorded, fallback)
    return out


def _joint_scales(model, joint, segments, scale) -> None:
    """Spread of each coordinate that was recorded; others keep theirs."""
    kind, q, v = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    width = {0: 6, 1: 3}.get(kind, 1)
    recorded = {
        (a.source, a.index): j for j, a in ((j, column_address(model, c)) for j, c in enumerate(segments.columns))
    }
    for k in range(width):
        straight = kind in (2, 3) or (kind == 0 and k < 3)
        position = recorded.get(("qpos", q + k)) if straight else None
        velocity = recorded.get(("qvel", v + k))
        if position is not None:
            scale[v + k] = _spread(segments.values[:, :, position], 0.5)
            with np.errstate(divide="ignore", invalid="ignore"):
                speed = np.diff(segments.values[:, :, position], axis=1) / np.diff(segments.time, axis=1)
            scale[model.nv + v + k] = _spread(speed, 1.0)
        elif not straight:
            scale[v + k] = 0.5
        if velocity is not None:
            scale[model.nv + v + k] = _spread(segments.values[:, :, velocity], scale[model.nv + v + k])


def _spread(values: np.ndarray, otherwise: float) -> float:
    """Standard deviation of what is finite; `otherwise` where nothing is."""
    finite = values[np.isfinite(values)]
    return max(float(np.std(finite)), 1e-6) if len(finite) > 1 else float(otherwise)


def _local_fit(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Level and slope at each segment's start of a quadratic through its first recorded samples; NaN without any."""
    level, slope = np.full(len(time), np.nan), np.full(len(time), np.nan)
    for s in range(len(time)):
        seen = np.flatnonzero(np.isfinite(values[s]))[:NUM_NEAR]
        if len(seen) == 0:
            continue
        degree = min(2, len(seen) - 1)
        span = max(time[s, seen[-1]] - time[s, 0], 1e-9)
        fit = np.polynomial.polynomial.polyfit((time[s, seen] - time[s, 0]) / span, values[s, seen], degree)
        level[s] = values[s, 0] if np.isfinite(values[s, 0]) else fit[0]
        slope[s] = fit[1] / span if degree else 0.0
    return level, slope


def _normalise_quaternions(model: "mujoco.MjModel", qpos: np.ndarray) -> None:
    for joint in range(model.njnt):
        shift = {0: 3, 1: 0}.get(int(model.jnt_type[joint]))
        if shift is not None:
            part = slice(int(model.jnt_qposadr[joint]) + shift, int(model.jnt_qposadr[joint]) + shift + 4)
            norm = np.linalg.norm(qpos[:, part], axis=1, keepdims=True)
            qpos[:, part] = np.where(norm > 1e-6, qpos[:, part] / np.maximum(norm, 1e-6), [1.0, 0, 0, 0])
