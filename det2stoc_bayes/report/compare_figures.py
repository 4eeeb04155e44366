"""Figures of several posteriors of one problem: forest, pairs, ranks, traces, autocorrelation, accuracy and cost."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from arviz_stats.base.array import array_stats
from jaxtyping import Float

from det2stoc_bayes.psis import thinned
from det2stoc_bayes.report import canvas
from det2stoc_bayes.report.canvas import Spec

type Draws = Float[np.ndarray, "_ _"]  # (chain, draw), of any number in each run
type Posterior = Mapping[str, Draws]  # by the parameter's name

HUES = (212, 14, 142, 278, 38, 186, 328, 96, 250, 60)
MOST_SHOWN = 4  # parameters in pairs
MOST_POINTS = 400  # of a set of draws in a panel
MOST_LAG = 60
PAD = 0.05  # of the intervals' range, left free to either side
ROW = 22  # pixels a line of the forest
LEVEL = 0.95  # of intervals, and of the band that ranks of one posterior stay in (each by itself)


def colour(number: int) -> str:
    """Of a run, as its number in the list."""
    return f"hsl({HUES[number % len(HUES)]}, 62%, 50%)"


def forest_figure(posteriors: Mapping[str, Posterior], name: str) -> Spec:
    """Median and intervals of a parameter under every method that has it, the first on top."""
    rows = [(number, label, np.ravel(p[name])) for number, (label, p) in enumerate(posteriors.items()) if name in p]
    traces, ends = [], []
    for y, (number, label, draws) in enumerate(reversed(rows)):
        low, middle, high = np.quantile(draws, [(1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2])
        ends += [float(low), float(high)]
        inner = np.quantile(draws, [0.25, 0.75])
        style: Spec = {"hovertemplate": f"%{{x:.4~g}}<extra>{label}</extra>"}
        traces.append(canvas.line(np.array([low, high]), np.full(2, y), label, colour(number), width=1.6, **style))
        traces.append(canvas.line(inner, np.full(2, y), label, colour(number), width=5, **style))
        dot = {"mode": "markers", "marker": {"color": colour(number), "size": 8}}
        traces.append(canvas.line(np.array([middle]), np.array([y]), label, colour(number), **style, **dot))
    labels = [label for _, label, _ in reversed(rows)]
    ticks = {"tickmode": "array", "tickvals": list(range(len(rows))), "ticktext": labels, "automargin": True}
    pad = PAD * (max(ends) - min(ends)) or 0.01 * abs(min(ends)) or 1e-9
    reach = [min(ends) - pad, max(ends) + pad]
    y_axis = canvas.axis(**ticks, range=[-0.7, len(rows) - 0.3], showgrid=False)
    axes = {"xaxis": canvas.axis(range=reach), "yaxis": y_axis}
    return {"data": traces, "layout": canvas.layout(70 + ROW * len(rows), **axes, hovermode="closest")}


def pair_figure(posterior: Posterior, reference: Posterior | None, number: int) -> Spec:
    """Draws of a method over those of the reference, the first parameters against each other."""
    names = list(posterior)[:MOST_SHOWN]
    pairs = [(a, b) for i, b in enumerate(names) for a in names[:i]] or [(names[0], names[0])]
    columns = min(len(pairs), 3)
    rows = -(-len(pairs) // columns)
    spec, traces = canvas.layout(250 * rows, hovermode=False), []
    for k, (a, b) in enumerate(pairs):
        row, column = divmod(k, columns)
        x_name, y_name = (f"{axis}{k + 1}" if k else axis for axis in "xy")
        left, top = column / columns, 1 - row / rows
        x_room, y_room = [left, left + 0.8 / columns], [top - 0.74 / rows, top]
        spec["xaxis" + x_name[1:]] = canvas.axis(a, domain=x_room, anchor=y_name, nticks=4)
        spec["yaxis" + y_name[1:]] = canvas.axis(b, domain=y_room, anchor=x_name, nticks=4)
        for shown, of, name in ((reference, "var(--muted)", "reference"), (posterior, colour(number), "draws")):
            if shown is None or a not in shown or b not in shown:
                continue
            x, y = (thinned(np.ravel(shown[n]), MOST_POINTS) for n in (a, b))
            dots = {"mode": "markers", "marker": {"color": of, "size": 3, "opacity": 0.55}, "xaxis": x_name}
            traces.append(canvas.line(x, y, name, of, y_axis=y_name, **dots))
    return {"data": traces, "layout": spec}


def rank_figure(posterior: Posterior) -> Spec:
    """How far the ranks of each chain's draws are from even, within the band where even ones stay.

    Fractional ranks among all chains' draws; the chains agree where every line stays near 0 (Vehtari et al., 2021).
    """
    names, traces = list(posterior)[:MOST_SHOWN], []
    for row, name in enumerate(names):
        draws = posterior[name]
        ranks = np.argsort(np.argsort(draws, axis=None)).reshape(draws.shape) / draws.size
        level = np.linspace(0, 1, 101)
        half = 1.96 * np.sqrt(level * (1 - level) / max(draws.shape[1], 1))
        outline = np.concatenate([level, level[::-1]]), np.concatenate([half, -half[::-1]])
        x, y = (o.tolist() for o in outline)
        traces.append(canvas.area(x, y, canvas.BAND, y_axis=canvas.y_name(row)))
        for number, chain in enumerate(ranks[:8]):
            share = np.searchsorted(np.sort(chain), level, side="right") / len(chain)
            style: Spec = {"width": 1.2, "y_axis": canvas.y_name(row)}
            traces.append(canvas.line(level, share - level, f"chain {number}", colour(number), **style))
    return {"data": traces, "layout": canvas.panels(names, "fractional rank", [{} for _ in names])}


def trace_figure(posterior: Posterior) -> Spec:
    """Draws of each chain in their order."""
    names, traces = list(posterior)[:MOST_SHOWN], []
    for row, name in enumerate(names):
        for number, chain in enumerate(posterior[name][:8]):
            at = thinned(np.arange(len(chain)), MOST_POINTS)
            style: Spec = {"width": 0.9, "y_axis": canvas.y_name(row)}
            traces.append(canvas.line(at.astype(float), chain[at], f"chain {number}", colour(number), **style))
    return {"data": traces, "layout": canvas.panels(names, "draw", [{} for _ in names])}


def autocorrelation_figure(posterior: Posterior) -> Spec:
    """Autocorrelation of the draws, mean over the chains."""
    stats: Any = array_stats
    names, traces = list(posterior)[:MOST_SHOWN], []
    for row, name in enumerate(names):
        draws = posterior[name]
        lags = min(MOST_LAG, draws.shape[1] - 1)
        curves = np.stack([np.asarray(stats.autocorr(chain))[: lags + 1] for chain in draws])
        style: Spec = {"y_axis": canvas.y_name(row), "hovertemplate": "%{y:.2f}"}
        mean = np.nan_to_num(curves.mean(0))
        traces.append(canvas.line(np.arange(lags + 1.0), mean, name, canvas.AFTER, **style))
    return {"data": traces, "layout": canvas.panels(names, "lag [draws]", [{"range": [-0.25, 1.05]} for _ in names])}


def energy_figure(energy: Draws) -> Spec:
    """Energy about each chain's mean, and its change from draw to draw: as wide as each other where chains mix well."""
    about, change = (energy - energy.mean(1, keepdims=True)).ravel(), np.diff(energy, axis=1).ravel()
    low, high = np.quantile(np.concatenate([about, change]), [0.001, 0.999])
    edges = np.linspace(float(low), float(high), 61)
    middle, traces = (edges[1:] + edges[:-1]) / 2, []
    for values, name, of in ((about, "energy", canvas.BEFORE), (change, "change of energy", canvas.AFTER)):
        heights = np.histogram(values, edges, density=True)[0]
        style: Spec = {"hovertemplate": "%{y:.3f}"}
        traces.append(canvas.line(middle, heights, name, of, **style))
    axes = {"xaxis": canvas.axis("energy less its mean; its change (second colour)"), "yaxis": canvas.axis("density")}
    return {"data": traces, "layout": canvas.layout(220, **axes)}


def cost_figure(rows: Sequence[Any], cost: str, title: str) -> Spec:
    """C2ST against the reference (0.5: none) over what a run took."""
    known = [(number, row) for number, row in enumerate(rows) if row.c2st is not None and getattr(row, cost) > 0]
    traces = []
    for number, row in known:
        dot: Spec = {"mode": "markers+text", "marker": {"color": colour(number), "size": 10}, "text": [row.label]}
        dot |= {"textposition": "top center", "hovertemplate": "%{text}: %{y:.3f}<extra></extra>"}
        where = np.array([float(getattr(row, cost))]), np.array([row.c2st])
        traces.append(canvas.line(*where, row.label, colour(number), **dot))
    axes = {"xaxis": canvas.axis(title, type="log"), "yaxis": canvas.axis("C2ST", range=[0.45, 1.02])}
    return {"data": traces, "layout": canvas.layout(320, **axes, hovermode="closest")}
