"""Recorded episodes of an experiment: what each had drawn of psi beside what was inferred of it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from det2stoc_bayes.report import canvas, numbers
from det2stoc_bayes.report.canvas import Spec


def population_rows(table: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Each row of the table of populations, every mean with its sd."""
    return [
        {"psi": psi, "seed": seed, "values": [numbers.plus_minus(*pair) for pair in zip(v[::2], v[1::2], strict=True)]}
        for psi, seed, *v in table["rows"]
    ]


def episode_figure(seeds: Sequence[Mapping[str, Any]], exact: Sequence[Mapping[str, Any]], j: int, unit: str) -> Spec:
    """Inferred against drawn, with bars of 2 sd, and the line on which both agree."""
    drawn = np.concatenate([np.array(e["drawn"])[:, j] for e in exact])
    learned = [[m for m in seed["models"].values() if "episodes" in m][-1] for seed in seeds[: len(exact)]]
    kinds = {
        "det2stoc": (
            np.concatenate([np.array(m["episodes"])[:, j] for m in learned]),
            np.concatenate([np.array(m["episode_sds"])[:, j] for m in learned]),
            canvas.AFTER,
        ),
        "exact": (
            np.concatenate([np.array(e["mean"])[:, j] for e in exact]),
            np.sqrt(np.concatenate([np.array(e["covariance"])[:, j, j] for e in exact])),
            canvas.OBSERVED,
        ),
    }
    ends = np.array([drawn.min(), drawn.max()])
    traces = [canvas.line(ends, ends, "inferred as drawn", "var(--muted)", line={"dash": "dot"})]
    for name, (mean, sd, colour) in kinds.items():
        bars = {"type": "data", "array": (2 * sd).tolist(), "color": colour, "thickness": 1}
        hover = f"{name}: %{{x:.4~g}} drawn, %{{y:.4~g}} inferred<extra></extra>"
        traces.append(
            canvas.line(drawn, mean, name, colour, mode="markers", error_y=bars, marker={"size": 6, "color": colour},
                        hovertemplate=hover)
        )  # fmt: skip
    end = "" if unit == "1" else f" [{unit}]"
    axes = {"xaxis": canvas.axis(f"drawn{end}"), "yaxis": canvas.axis(f"inferred{end}")}
    return {"data": traces, "layout": canvas.layout(320, **axes, hovermode="closest")}
