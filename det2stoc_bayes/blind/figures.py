"""Figures of the proof's page: stated probabilities beside shares that were true, seconds, and a case's rollout."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from det2stoc_bayes.blind.statements import Reliability
from det2stoc_bayes.blind.summary import Row
from det2stoc_bayes.report import canvas
from det2stoc_bayes.report.canvas import Spec

JITTER = 0.28


def reliability_figure(found: Reliability) -> Spec:
    """The share of statements that were true over the stated probability, with 95 % intervals."""
    stated, true = (np.array([getattr(b, name) for b in found.bins]) for name in ("stated", "true"))
    low, high = (np.array([getattr(b, name) for b in found.bins]) for name in ("low", "high"))
    points: Spec = {
        "type": "scatter", "mode": "markers", "x": stated.tolist(), "y": true.tolist(),
        "marker": {"color": canvas.AFTER, "size": [float(7 + 2 * np.log10(b.count)) for b in found.bins]},
        "error_y": {"type": "data", "symmetric": False, "array": (high - true).tolist(),
                    "arrayminus": (true - low).tolist(), "color": canvas.AFTER, "thickness": 1.4},
        "text": [f"{b.count} statements" for b in found.bins],
        "hovertemplate": "%{text}: stated %{x:.3f}, true %{y:.3f}<extra></extra>", "yaxis": "y",
    }  # fmt: skip
    ends = np.array([0.0, 1.0])
    diagonal = canvas.line(ends, ends, "right", canvas.OBSERVED, width=1, line={"dash": "dot"})
    axes = {
        "xaxis": canvas.axis("stated probability", range=[-0.03, 1.03]),
        "yaxis": canvas.axis("share that was true", range=[-0.03, 1.03]),
    }
    return {"data": [diagonal, points], "layout": canvas.layout(380, **axes, hovermode="closest")}


def seconds_figure(rows: Sequence[Row]) -> Spec:
    """Seconds of every diagnosis by system, on a logarithmic axis; misses in the colour of what is wrong."""
    systems, random = list(dict.fromkeys(r.system for r in rows)), np.random.default_rng(0)
    traces = []
    for right, colour in ((True, canvas.AFTER), (False, canvas.BEFORE)):
        mine = [r for r in rows if r.score.named == right]
        height = [systems.index(r.system) + float(random.uniform(-JITTER, JITTER)) for r in mine]
        traces.append({
            "type": "scatter", "mode": "markers", "x": [r.seconds for r in mine], "y": height,
            "marker": {"color": colour, "size": 6, "opacity": 0.75}, "yaxis": "y",
            "text": [r.kind for r in mine], "hovertemplate": "%{x:.0f} s, %{text}<extra></extra>",
        })  # fmt: skip
    ticks = {"tickmode": "array", "tickvals": list(range(len(systems))), "ticktext": systems}
    axes = {
        "xaxis": canvas.axis("seconds", type="log", dtick=1),
        "yaxis": canvas.axis(**ticks, range=[len(systems) - 0.4, -0.6], showgrid=False),
    }
    margin = {"l": 96, "r": 12, "t": canvas.TOP, "b": canvas.BOTTOM}
    return {"data": traces, "layout": canvas.layout(90 + 26 * len(systems), **axes, hovermode="closest", margin=margin)}


def rollout_figure(told: Mapping[str, Any]) -> Spec:
    """A held-out recording's worst column: recorded, predicted before and after."""
    time, traces = np.array(told["time"], float), []
    for name, label, colour in (
        ("before", "before", canvas.BEFORE),
        ("after", "after", canvas.AFTER),
        ("observed", "recorded", canvas.OBSERVED),
    ):
        if name in told:
            values = np.array(told[name], float)
            style: Spec = {"hovertemplate": "%{y:.4~g}", "width": 1.2 if name == "observed" else 2.0}
            style["meta"] = label
            traces.append(canvas.line(time, values, label, colour, **style))
    axes = {"xaxis": canvas.axis("time [s]"), "yaxis": canvas.axis(told["channel"])}
    return {"data": traces, "layout": canvas.layout(220, **axes)}
