"""Long recordings made short enough for a page, without losing what stands out."""

import numpy as np
import xarray as xr

MAX_POINTS = 1500
MIN_POINTS = 240
TRACE_BYTES = 10.7  # of one point: x and y in single precision, base64
BUDGET_BYTES = 2_600_000
PANELS_OPEN = 6


def decimate(time: np.ndarray, values: np.ndarray, max_points: int) -> tuple[np.ndarray, np.ndarray]:
    """At most so many samples, with the smallest and the largest of each stretch; gaps (NaN) stay gaps."""
    time, values = np.asarray(time, float), np.asarray(values, float)
    size = values.size
    if size <= max_points:
        return time, values
    stretches = max(max_points // 2, 1)
    width = -(-size // stretches)
    padded = np.full(-(-size // width) * width, np.nan)
    padded[:size] = values
    rows = padded.reshape(-1, width)
    start = np.arange(rows.shape[0]) * width
    low = np.argmin(np.where(np.isnan(rows), np.inf, rows), axis=1) + start
    high = np.argmax(np.where(np.isnan(rows), -np.inf, rows), axis=1) + start
    keep = np.unique(np.concatenate([low, high]))
    return time[keep], values[keep]


def spans(time: np.ndarray, condition: np.ndarray) -> list[tuple[float, float]]:
    """Stretches of time where the condition holds; those closer than 1/400 of the whole are joined."""
    time, holds = np.asarray(time, float), np.asarray(condition, bool)
    if not holds.any():
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(int)))
    middle = np.concatenate([time[:1], (time[1:] + time[:-1]) / 2, time[-1:]])
    joined: list[list[float]] = []
    for first, end in zip(middle[edges[::2]], middle[edges[1::2]], strict=True):
        if joined and first - joined[-1][1] < (time[-1] - time[0]) / 400:
            joined[-1][1] = float(end)
        else:
            joined.append([float(first), float(end)])
    return [(first, end) for first, end in joined]


def channel_order(rollout: xr.Dataset) -> list[str]:
    """Channels from the worst predicted one (before, against its noise) to the best."""
    mean_square = (rollout["residual_before"] ** 2).mean("sample").fillna(0.0)
    order = np.argsort(-mean_square.values, kind="stable")
    return [str(name) for name in rollout["channel"].values[order]]


def worst_moment(rollout: xr.Dataset) -> float:
    """The time [s] at which the model before is farthest off, by the whitened residuals of all channels."""
    squares = np.nan_to_num(rollout["residual_before"].transpose("sample", "channel").values ** 2, posinf=0.0)
    return float(rollout["time"].values[squares.sum(1).argmax()])


def selection(rollouts: dict[str, xr.Dataset]) -> tuple[list[str], int]:
    """The recordings that the page can hold, worst first within each role, and the points each trace gets.

    All of them, where that fits; else held-out ones first, then those that the believed model predicts worst.
    """
    traces = {stem: 6 * data.sizes["channel"] for stem, data in rollouts.items()}
    total = sum(traces.values())
    points = int(BUDGET_BYTES / (TRACE_BYTES * max(total, 1)))
    if points >= MIN_POINTS:
        return list(rollouts), min(points, MAX_POINTS)
    ranked = sorted(rollouts, key=lambda stem: (rollouts[stem].attrs.get("role") != "holdout", -misfit(rollouts[stem])))
    kept, used = [], 0.0
    for stem in ranked:
        used += traces[stem] * MIN_POINTS * TRACE_BYTES
        if kept and used > BUDGET_BYTES:
            break
        kept.append(stem)
    return [stem for stem in rollouts if stem in kept], MIN_POINTS


def misfit(rollout: xr.Dataset, which: str = "before") -> float:
    """Root mean square of the whitened residual over all channels; 1 when the model is right."""
    values = rollout[f"residual_{which}"].values
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else 0.0
