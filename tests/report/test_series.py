"""Decimation keeps what stands out; a page stays small."""

import numpy as np
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from det2stoc_bayes.report import series


@given(size=st.integers(1, 5000), points=st.integers(10, 600), spike=st.integers(0, 4999))
def test_spikes_survive_decimation(size: int, points: int, spike: int) -> None:
    values = np.sin(np.arange(size))
    values[spike % size] = 50.0
    time, kept = series.decimate(np.arange(size), values, points)
    assert kept.size <= max(points, 1) and kept.max() == 50.0
    assert np.all(np.diff(time) > 0) and np.array_equal(kept, values[time.astype(int)])


def test_a_long_gap_stays_a_gap() -> None:
    values = np.ones(4000)
    values[1000:2000] = np.nan
    time, kept = series.decimate(np.arange(4000), values, 100)
    inside = (time >= 1000) & (time < 2000)
    assert np.isnan(kept[inside]).all() and inside.any() and np.isfinite(kept[~inside]).all()


def test_spans_cover_where_the_condition_holds() -> None:
    time = np.arange(10.0)
    assert series.spans(time, time < 0) == []
    assert series.spans(time, (time >= 3) & (time <= 5)) == [(2.5, 5.5)]
    assert series.spans(time, time >= 0) == [(0.0, 9.0)]


def _rollout(num_channels: int, role: str, misfit: float) -> xr.Dataset:
    return xr.Dataset(
        {"residual_before": (("sample", "channel"), np.full((5, num_channels), misfit))},
        coords={"channel": [f"qpos/{i}" for i in range(num_channels)]},
        attrs={"role": role},
    )


def test_too_many_recordings_leave_out_those_predicted_well() -> None:
    rollouts = {f"r{i:03d}": _rollout(14, "recordings", float(i)) for i in range(100)}
    rollouts["held"] = _rollout(14, "holdout", 0.1)
    stems, points = series.selection(rollouts)
    assert points == series.MIN_POINTS
    assert "held" in stems and "r099" in stems and "r000" not in stems
    assert len(stems) * 14 * 6 * points * series.TRACE_BYTES <= series.BUDGET_BYTES
    assert series.selection({"one": _rollout(2, "recordings", 1.0)}) == (["one"], series.MAX_POINTS)


def test_channels_come_worst_first() -> None:
    rollout = _rollout(3, "recordings", 1.0)
    rollout["residual_before"][:, 2] = 9.0
    rollout["residual_before"][:, 1] = np.nan
    assert series.channel_order(rollout) == ["qpos/2", "qpos/0", "qpos/1"]
