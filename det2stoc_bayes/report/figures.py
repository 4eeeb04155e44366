"""The figures over recordings: rollouts, whitened residuals, and how those are distributed."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from scipy import stats

from det2stoc_bayes.report import canvas, series
from det2stoc_bayes.report.canvas import Spec, line


def rollout_figure(rollout: xr.Dataset, channels: Sequence[str], names: Mapping[str, str], points: int) -> Spec:
    """Recorded and predicted channels over time, one panel each, with two noise sds around the recording."""
    time = rollout["time"].values
    stretches = _stretches(rollout)
    traces: list[Spec] = []
    axes = []
    for row, channel in enumerate(channels):
        y_axis = canvas.y_name(row)
        one = rollout.sel(channel=channel)
        observed = one["observed"].values
        drawn = {which: one[which].values for which in names}
        low, high = _range([observed, *drawn.values()])
        axes.append({"range": [low, high]})
        traces += _shaded(stretches, low, high, y_axis)
        traces += _noise_band(time, observed, 2 * float(one["noise_sd"]), min(points, 500), y_axis)
        style: Spec = {"hovertemplate": "%{y:.4~g}", "y_axis": y_axis}
        for which, values in drawn.items():
            x, y = series.decimate(time, values, points)
            traces.append(line(x, y, names[which], canvas.colour_of(which), meta=which, **style))
        x, y = series.decimate(time, observed, points)
        dots = {"mode": "markers", "marker": {"color": canvas.OBSERVED, "size": 3.5}}
        style |= dots if np.isfinite(observed).sum() <= 150 else {}
        traces.append(line(x, y, "recorded", canvas.OBSERVED, width=1.1, meta="recorded", **style))
    titles = [_labelled(rollout, channel) for channel in channels]
    return {"data": traces, "layout": canvas.panels(titles, "time [s]", axes)}


def residual_figure(rollout: xr.Dataset, channels: Sequence[str], names: Mapping[str, str], points: int) -> Spec:
    """Whitened residuals over time on an asinh scale, so that 1 and 100 noise sds both can be read."""
    time = rollout["time"].values
    stretches = _stretches(rollout)
    chosen = rollout.sel(channel=list(channels)).transpose("sample", "channel", ...)
    drawn = {which: np.arcsinh(chosen[f"residual_{which}"].values) for which in names}
    reach = 1.08 * max(np.arcsinh(4.0), *(np.nanmax(np.abs(v), initial=0.0) for v in drawn.values()))
    two = float(np.arcsinh(2.0))
    ends = [float(time.min()), float(time.max())] if time.size else [0.0, 1.0]
    traces: list[Spec] = []
    for row in range(len(channels)):
        y_axis = canvas.y_name(row)
        traces += _shaded(stretches, -reach, reach, y_axis)
        traces.append(canvas.area([*ends, *ends[::-1]], [-two, -two, two, two], canvas.BAND, y_axis=y_axis))
        for which, values in drawn.items():
            x, y = series.decimate(time, values[:, row], points)
            traces.append(line(x, y, names[which], canvas.colour_of(which), width=1.1, y_axis=y_axis, meta=which))
    titles = [_labelled(rollout, channel) for channel in channels]
    axes = [{"range": [-reach, reach], **canvas.asinh_ticks(reach)} for _ in channels]
    return {"data": traces, "layout": canvas.panels(titles, "time [s]", axes)}


def histogram_figure(residuals: Mapping[str, np.ndarray], names: Mapping[str, str]) -> Spec:
    """Densities of all whitened residuals on an asinh scale, against the normal that noise alone gives."""
    reach = max(np.arcsinh(5.0), *(np.max(np.abs(np.arcsinh(v)), initial=0.0) for v in residuals.values()))
    edges = np.linspace(-reach, reach, 81)
    traces = []
    for which, values in residuals.items():
        height = np.histogram(np.arcsinh(values), edges)[0] / (max(values.size, 1) * (edges[1] - edges[0]))
        colour = canvas.colour_of(which)
        style: Spec = {
            "line": {"shape": "hv"},
            "fill": "tozeroy",
            "fillcolor": canvas.soft(colour),
            "width": 1.6,
            "meta": which,
        }
        traces.append(line(edges, np.append(height, 0), names[which], colour, **style))
    smooth = np.linspace(-reach, reach, 241)
    normal = stats.norm.pdf(np.sinh(smooth)) * np.cosh(smooth)
    traces.append(line(smooth, normal, "noise alone", canvas.OBSERVED, width=1.6, line={"dash": "dot"}))
    x = canvas.axis("whitened residual [noise sd]", **canvas.asinh_ticks(reach))
    y = canvas.axis("density", showticklabels=False, showgrid=False, rangemode="tozero")
    return {"data": traces, "layout": canvas.layout(300, xaxis=x, yaxis=y)}


def quantile_figure(residuals: Mapping[str, np.ndarray], names: Mapping[str, str]) -> Spec:
    """Quantiles of the whitened residuals against those of the normal; on the dotted line noise is all."""
    normal = np.linspace(-3.3, 3.3, 133)
    levels = stats.norm.cdf(normal)
    reach, traces = float(np.arcsinh(4.0)), []
    for which, values in residuals.items():
        inside = (levels * values.size > 0.5) & ((1 - levels) * values.size > 0.5)
        if not inside.any():
            continue
        quantiles = np.arcsinh(np.quantile(values, levels[inside]))
        reach = max(reach, float(np.abs(quantiles).max()))
        traces.append(line(normal[inside], quantiles, names[which], canvas.colour_of(which), width=2.4, meta=which))
    dotted: Spec = {"width": 1.6, "line": {"dash": "dot"}}
    traces.append(line(normal, np.arcsinh(normal), "noise alone", canvas.OBSERVED, **dotted))
    x = canvas.axis("quantile of the normal", dtick=1, range=[-3.4, 3.4])
    y = canvas.axis(**canvas.asinh_ticks(1.06 * reach), range=[-1.06 * reach, 1.06 * reach])
    return {"data": traces, "layout": canvas.layout(300, xaxis=x, yaxis=y)}


def _labelled(rollout: xr.Dataset, channel: str) -> str:
    unit = str(rollout["unit"].sel(channel=channel).item()) if "unit" in rollout.coords else ""
    return f"{channel} [{unit}]" if unit else channel


def _stretches(rollout: xr.Dataset) -> list[tuple[float, float]]:
    if "condition" not in rollout:
        return []
    return series.spans(rollout["time"].values, rollout["condition"].values)


def _shaded(stretches: Sequence[tuple[float, float]], low: float, high: float, y_axis: str) -> list[Spec]:
    if not stretches:
        return []
    x = [value for first, end in stretches for value in (first, first, end, end, None)]
    return [canvas.area(x, [low, high, high, low, None] * len(stretches), canvas.SPAN, y_axis=y_axis)]


def _noise_band(time: np.ndarray, observed: np.ndarray, half: float, points: int, y_axis: str) -> list[Spec]:
    seen = np.isfinite(observed)
    if not seen.any() or not np.isfinite(half):
        return []
    x, y = series.decimate(time[seen], observed[seen], points)
    outline = np.concatenate([x, x[::-1]]), np.concatenate([y + half, (y - half)[::-1]])
    filled: Spec = {"fill": "toself", "fillcolor": canvas.BAND, "width": 0, "y_axis": y_axis, "meta": "band"}
    return [line(*outline, "noise", canvas.BAND, **filled)]


def _range(arrays: Sequence[np.ndarray]) -> tuple[float, float]:
    """Limits of a panel: all that was recorded, and predictions as far as 1.5 times beyond."""
    observed = arrays[0][np.isfinite(arrays[0])]
    every = np.concatenate([values[np.isfinite(values)] for values in arrays])
    if not every.size:
        return -1.0, 1.0
    base = observed if observed.size else every
    low, high = float(base.min()), float(base.max())
    width = max(high - low, 1e-12, 1e-6 * max(abs(low), abs(high)))
    low, high = max(float(every.min()), low - 1.5 * width), min(float(every.max()), high + 1.5 * width)
    pad = 0.06 * max(high - low, width)
    return low - pad, high + pad
