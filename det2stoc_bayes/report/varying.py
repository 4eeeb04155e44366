"""A psi that varies by trajectory: its posterior recording by recording."""

import html

import numpy as np
import xarray as xr
from arviz_stats.base.array import array_stats

from det2stoc_bayes.report import canvas
from det2stoc_bayes.report.canvas import Spec

MAX_RECORDINGS = 60


def varying_figures(fit: xr.DataTree, names: dict[str, str]) -> list[tuple[str, Spec]]:
    """One figure for each scalar psi with a `recording` dimension."""
    found: dict[str, dict[str, xr.DataArray]] = {}
    for which in names:
        try:
            variables = fit[f"{which}/posterior"].to_dataset().data_vars
        except KeyError:
            continue
        for name, data in variables.items():
            if set(data.dims) == {"chain", "draw", "recording"}:
                found.setdefault(str(name), {})[which] = data.isel(recording=slice(MAX_RECORDINGS))
    return [(name, _forest(draws, names)) for name, draws in found.items()]


def _forest(draws: dict[str, xr.DataArray], names: dict[str, str]) -> Spec:
    first = next(iter(draws.values()))
    labels = [html.escape(str(label)) for label in first["recording"].values]
    rows = list(range(len(labels)))
    traces = [_intervals(data, which, names[which]) for which, data in draws.items()]
    x = canvas.axis(str(first.attrs.get("unit", "")))
    y = canvas.axis(tickvals=rows, ticktext=labels, range=[len(labels) - 0.5, -0.5], automargin=True)
    shape = canvas.layout(canvas.TOP + canvas.BOTTOM + 26 * len(labels), xaxis=x, yaxis=y, hovermode="closest")
    return {"data": traces, "layout": shape}


def _intervals(data: xr.DataArray, which: str, name: str) -> Spec:
    values = data.transpose("recording", "chain", "draw").values
    values = values.reshape(values.shape[0], -1)
    bounds, mean = array_stats.eti(values, 0.95, axis=-1), values.mean(axis=1)
    side = -0.14 if which == "before" else 0.14
    error = {"type": "data", "symmetric": False, "thickness": 1.6, "width": 0}
    error |= {"array": canvas.array(bounds[:, 1] - mean), "arrayminus": canvas.array(mean - bounds[:, 0])}
    marker = {"color": canvas.colour_of(which), "size": 7}
    where = np.arange(values.shape[0]) + side
    return canvas.line(
        mean, where, name, canvas.colour_of(which), mode="markers", marker=marker, error_x=error,
        hovertemplate="%{x:.4~g}",
    )  # fmt: skip
