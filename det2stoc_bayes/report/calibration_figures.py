"""Figures of a calibration: ranks, how far their distribution is from even, and expected coverage."""

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from det2stoc_bayes import coverage
from det2stoc_bayes.report import canvas
from det2stoc_bayes.report.canvas import Spec

CONFIDENCE = 0.99  # of the bands
NUM_LEVELS = 99


def rank_figure(ranks: Int[np.ndarray, " replications"], num_draws: int) -> Spec:
    """Histogram of an unknown's ranks, and the band that each bin stays in (by itself) if they are even."""
    bins = coverage.num_bins(len(ranks), num_draws)
    edges = np.linspace(0, num_draws + 1, bins + 1).round()
    counts = np.histogram(ranks, edges - 0.5)[0]
    share = np.diff(edges) / (num_draws + 1)
    low, high = (stats.binom.ppf(q, len(ranks), share) for q in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    x = np.repeat(edges, 2)[1:-1].tolist()
    band = canvas.area(x + x[::-1], np.repeat(low, 2).tolist() + np.repeat(high, 2)[::-1].tolist(), canvas.BAND)
    middle = 0.5 * (edges[1:] + edges[:-1])
    bars: Spec = {
        "type": "bar", "x": canvas.array(middle), "y": canvas.array(counts), "width": canvas.array(np.diff(edges)),
        "marker": {"color": canvas.soft(canvas.AFTER), "line": {"color": canvas.AFTER, "width": 1}},
        "hovertemplate": "%{y} replications<extra></extra>", "yaxis": "y",
    }  # fmt: skip
    top = 1.15 * max(counts.max(), high.max())
    axes = {"xaxis": canvas.axis("rank of the truth"), "yaxis": canvas.axis("replications", range=[0, top])}
    return {"data": [band, bars], "layout": canvas.layout(230, **axes, hovermode="closest", bargap=0)}


def difference_figure(ranks: Int[np.ndarray, " replications"], num_draws: int) -> Spec:
    """How the ranks' distribution differs from an even one, and the band that all of it stays in if they are even."""
    level = np.arange(1, NUM_LEVELS + 1) / (NUM_LEVELS + 1)
    shares = (ranks + 0.5) / (num_draws + 1)
    found = np.searchsorted(np.sort(shares), level, side="right") / len(shares)
    return _difference(level, found - level, len(shares), "share of the ranks' range")


def coverage_figure(credibility: Float[np.ndarray, " replications"]) -> Spec:
    """How often truths lie within regions of a level: the level itself, if calibrated."""
    level = np.arange(1, NUM_LEVELS + 1) / (NUM_LEVELS + 1)
    low, high = _band(len(credibility), level)
    found = coverage.expected_coverage(credibility, level)
    style: Spec = {"hovertemplate": "%{x:.2f}: %{y:.3f}<extra></extra>"}
    traces = [
        canvas.area([*level, *level[::-1]], [*low.tolist(), *high[::-1].tolist()], canvas.BAND),
        canvas.line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "", canvas.OBSERVED, width=1, line={"dash": "dot"}),
        canvas.line(level, found, "found", canvas.AFTER, **style),
    ]
    axes = {"xaxis": canvas.axis("credible level", range=[0, 1]), "yaxis": canvas.axis("coverage", range=[0, 1])}
    return {"data": traces, "layout": canvas.layout(360, **axes, hovermode="closest")}


def _difference(level: np.ndarray, difference: np.ndarray, count: int, title: str) -> Spec:
    low, high = _band(count, level) - level
    style: Spec = {"hovertemplate": "%{x:.2f}: %{y:.3f}<extra></extra>"}
    traces = [
        canvas.area([*level, *level[::-1]], [*low.tolist(), *high[::-1].tolist()], canvas.BAND),
        canvas.line(level, difference, "difference", canvas.AFTER, **style),
    ]
    axes = {"xaxis": canvas.axis(title, range=[0, 1]), "yaxis": canvas.axis("difference")}
    return {"data": traces, "layout": canvas.layout(230, **axes, hovermode="closest")}


def _band(count: int, level: np.ndarray) -> Float[np.ndarray, "2 levels"]:
    return coverage.ecdf_band(count, level, CONFIDENCE, np.random.default_rng(0))
