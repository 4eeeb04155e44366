"""First guesses of each segment's initial state, and how uncertain they are."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.engines.rotations import relative_rotation, rotated
from det2stoc_bayes.engines.state_columns import quaternion_address, state_columns
from det2stoc_bayes.segments import Segments

if TYPE_CHECKING:
    import mujoco

NUM_NEAR = 9  # samples of the local fit
TURN = 0.5  # rad: spread of an orientation
SPIN = 10.0  # rad/s: spread of a turning speed that no column shows

type Series = Mapping[tuple[str, int], Float[np.ndarray, "segments samples"]]


@dataclass(frozen=True)
class StartGuess:
    """A start for each segment, and the sd of a wide prior about it, in tangent coordinates (positions, velocities)."""

    start: Start
    prior_sd: Float[np.ndarray, "segments states"]
    scale: Float[np.ndarray, " states"]  # typical magnitude of each coordinate's variation
    seen: Bool[np.ndarray, " positions"]  # positions (tangent) that some column records

    def __getitem__(self, rows: Int[np.ndarray, " rows"]) -> "StartGuess":
        return StartGuess(self.start[rows], self.prior_sd[rows], self.scale, self.seen)


def guess_starts(model: "mujoco.MjModel", segments: Segments) -> StartGuess:
    """Recorded values where there are any, rates of change near the start for velocities that were not recorded.

    The prior is three times as wide as the coordinate's own variation, so that the samples decide. Positions that
    no column records stand at the model's own.
    """
    qpos = np.tile(model.qpos0, (segments.count, 1))
    qvel = np.zeros((segments.count, model.nv))
    scale, seen = np.ones(2 * model.nv), np.zeros(model.nv, bool)
    places = state_columns(model, segments.columns)
    series = {place: segments.values[:, :, j] for place, j in places.items()}
    for joint in range(model.njnt):
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        turn = quaternion_address(model, joint)
        for k in range(1 if turn is None else turn - q):  # a free joint's place has three numbers
            _straight(segments.time, series, (q + k, v + k), qpos, qvel, scale, seen)
        if turn is not None:
            _turning(segments.time, series, (turn, v + turn - q), qpos, qvel, scale, seen)
    act = np.zeros((segments.count, model.na))
    return StartGuess(Start(qpos, qvel, act), np.tile(3 * scale, (segments.count, 1)), scale, seen)


def _straight(time: np.ndarray, series: Series, at: tuple[int, int], qpos, qvel, scale, seen) -> None:
    """One coordinate that is a number: its columns of the arrays are written."""
    q, v = at
    position, nv = series.get(("qpos", q)), qvel.shape[1]
    if position is not None:
        level, slope = _local_fit(time, position, 2)
        there = np.isfinite(level)
        qpos[there, q], qvel[there, v] = level[there], slope[there]
        scale[v], scale[nv + v], seen[v] = _spread(position, 0.5), _spread(_rates(time, position), 1.0), True
    _speed(time, series, v, qvel, scale)


def _turning(time: np.ndarray, series: Series, at: tuple[int, int], qpos, qvel, scale, seen) -> None:
    """An orientation: angular velocities, in the body's frame as MuJoCo has them, from the turns between samples."""
    q, v = at
    parts = [series.get(("qpos", q + k)) for k in range(4)]
    scale[v : v + 3] = TURN
    given = [p for p in parts if p is not None]
    scale[qvel.shape[1] + v : qvel.shape[1] + v + 3] = SPIN
    if len(given) == 4:
        quaternion = np.stack(given, -1)
        rate, middle = _turn_rates(time, quaternion)
        for s in range(len(time)):
            first = np.flatnonzero(np.isfinite(quaternion[s, :, 0]))[:1]
            if len(first):
                speed = _at_start(middle[s], rate[s])
                back = speed * (time[s, 0] - time[s, first[0]])
                qpos[s, q : q + 4], qvel[s, v : v + 3] = rotated(quaternion[s, first[0]], back), speed
        spread = [_spread(rate[:, :, k], 1.0) for k in range(3)]
        scale[qvel.shape[1] + v : qvel.shape[1] + v + 3], seen[v : v + 3] = spread, True
    qpos[:, q : q + 4] /= np.linalg.norm(qpos[:, q : q + 4], axis=1, keepdims=True)
    for k in range(3):
        _speed(time, series, v + k, qvel, scale)


def _speed(time: np.ndarray, series: Series, v: int, qvel, scale) -> None:
    """A recorded velocity goes before one from positions."""
    speed = series.get(("qvel", v))
    if speed is not None:
        level, _ = _local_fit(time, speed, 2)
        there = np.isfinite(level)
        qvel[there, v] = level[there]
        place = qvel.shape[1] + v
        scale[place] = _spread(speed, scale[place])


def _turn_rates(time: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean angular velocities [rad/s] (segments, samples - 1, 3) between neighbours that were recorded, and when."""
    rate = np.full((len(time), time.shape[1] - 1, 3), np.nan)
    middle = np.full(rate.shape[:2], np.nan)
    for s in range(len(time)):
        there = np.flatnonzero(np.isfinite(quaternion[s]).all(-1))
        n = max(len(there) - 1, 0)
        t, q = time[s, there], quaternion[s, there]
        rate[s, :n] = relative_rotation(q[:-1], q[1:]) / np.diff(t)[:, None]
        middle[s, :n] = 0.5 * (t[1:] + t[:-1]) - time[s, 0]
    return rate, middle


def _at_start(middle: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """The rates (samples, 3) nearest to the start, extrapolated to it along a line."""
    there = np.flatnonzero(np.isfinite(middle))[: NUM_NEAR - 1]
    if len(there) == 0:
        return np.zeros(3)
    span = max(middle[there[-1]], 1e-9)
    return np.polynomial.polynomial.polyfit(middle[there] / span, rate[there], min(1, len(there) - 1))[0]


def _rates(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Slopes between neighbours that were recorded, of all segments."""
    found = []
    for t, x in zip(time, values, strict=True):
        there = np.isfinite(x)
        found.append(np.diff(x[there]) / np.diff(t[there]))
    return np.concatenate(found)


def _spread(values: np.ndarray, otherwise: float) -> float:
    """Standard deviation of what is finite; `otherwise` where nothing is."""
    finite = values[np.isfinite(values)]
    return max(float(np.std(finite)), 1e-6) if len(finite) > 1 else float(otherwise)


def _local_fit(time: np.ndarray, values: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Level and slope at each segment's start of a polynomial through its first recorded samples; NaN without any."""
    level, slope = np.full(len(time), np.nan), np.full(len(time), np.nan)
    for s in range(len(time)):
        near = np.flatnonzero(np.isfinite(values[s]))[:NUM_NEAR]
        if len(near) == 0:
            continue
        order = min(degree, len(near) - 1)
        span = max(time[s, near[-1]] - time[s, 0], 1e-9)
        fit = np.polynomial.polynomial.polyfit((time[s, near] - time[s, 0]) / span, values[s, near], order)
        level[s] = values[s, 0] if np.isfinite(values[s, 0]) else fit[0]
        slope[s] = fit[1] / span if order else 0.0
    return level, slope
