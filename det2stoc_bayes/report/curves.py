"""The figure of a force on no list: its curve with two sds to either side."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from det2stoc_bayes.report import canvas
from det2stoc_bayes.report.canvas import Spec

MOST_LINES = 4  # of a surface, each at one value of its second variable
HEIGHT = 230


def curve_figure(parameters: Mapping[str, Any]) -> Spec:
    """Force over its variable; of two variables over the first one, at a few values of the second."""
    curve, names = parameters["curve"], parameters.get("columns") or parameters["variables"]
    x, y = np.array(curve["x"], float), np.array(curve["y"], float)
    sd = np.array(curve.get("y_sd") or np.zeros(len(y)), float)
    traces = []
    if x.ndim == 1:
        outline = np.concatenate([y + 2 * sd, (y - 2 * sd)[::-1]])
        traces.append(canvas.area([*x, *x[::-1]], outline.tolist(), canvas.soft(canvas.AFTER)))
        traces.append(canvas.line(x, y, "force", canvas.AFTER, hovertemplate="%{y:.4~g}"))
    else:
        seconds = np.unique(x[:, 1])
        for i in np.unique(np.linspace(0, len(seconds) - 1, MOST_LINES).astype(int)):
            at = x[:, 1] == seconds[i]
            told = f"{names[1]} = {seconds[i]:.3g}"
            traces.append(canvas.line(x[at, 0], y[at], told, canvas.AFTER, hovertemplate="%{y:.4~g}"))
    axes = {"xaxis": canvas.axis(str(names[0])), "yaxis": canvas.axis(str(curve.get("unit", "")))}
    return {"data": traces, "layout": canvas.layout(HEIGHT, **axes)}
