"""Figures as plotly's own JSON: plain dicts, since its Python objects take seconds to check a page of them.

Colours are css variables, which the page resolves in the reader's theme.
"""

import base64
import html
from collections.abc import Sequence
from typing import Any

import numpy as np

BEFORE, AFTER, OBSERVED = "var(--before)", "var(--after)", "var(--observed)"
BAND, SPAN, FAINT = "var(--band)", "var(--span)", "var(--faint)"
ROW, GAP, TOP, BOTTOM = 132, 30, 24, 40

type Spec = dict[str, Any]


def colour_of(which: str) -> str:
    """Colour of `before`, of `after`, and of all else."""
    return {"before": BEFORE, "after": AFTER}.get(which, OBSERVED)


def soft(colour: str) -> str:
    """The same colour, see-through."""
    return colour.replace(")", "-soft)")


def array(values: np.ndarray) -> Spec:
    """Numbers as plotly.js reads them; single precision where that resolves their range; NaN is a gap."""
    values = np.asarray(values, float)
    seen = values[np.isfinite(values)]
    dtype = "f4" if seen.size and np.ptp(seen) > 1e-3 * np.abs(seen).max() else "f8"
    data = np.ascontiguousarray(values, f"<{dtype}")
    return {"dtype": dtype, "bdata": base64.b64encode(data.tobytes()).decode("ascii")}


def line(
    x: np.ndarray,
    y: np.ndarray,
    name: str,
    colour: str,
    *,
    width: float = 1.8,
    y_axis: str = "y",
    **more: Any,
) -> Spec:
    """A line; one that is to be hovered over gets a `hovertemplate`."""
    style = {"color": colour, "width": width} | more.pop("line", {})
    hover = {} if "hovertemplate" in more else {"hoverinfo": "skip"}
    trace = {"type": "scatter", "mode": "lines", "x": array(x), "y": array(y), "name": html.escape(name)}
    return trace | {"line": style, "yaxis": y_axis} | hover | more


def area(x: Sequence[float | None], y: Sequence[float | None], colour: str, *, y_axis: str = "y") -> Spec:
    """Filled outlines; None parts one from the next."""
    trace = {
        "type": "scatter",
        "mode": "lines",
        "x": list(x),
        "y": list(y),
        "fill": "toself",
        "fillcolor": colour,
    }
    return trace | {"line": {"width": 0}, "hoverinfo": "skip", "yaxis": y_axis}


def axis(title: str = "", **more: Any) -> Spec:
    """One axis in the page's manner."""
    base = {"gridcolor": FAINT, "zeroline": False, "linecolor": "var(--line)", "showline": True, "nticks": 6}
    return base | ({"title": {"text": html.escape(title), "standoff": 6}} if title else {}) | more


def layout(height: int, **more: Any) -> Spec:
    """What all figures share."""
    hover = {"bgcolor": "var(--paper)", "bordercolor": "var(--line)", "font": {"color": "var(--text)"}}
    base = {"height": height, "showlegend": False, "hovermode": "x unified", "hoverlabel": hover}
    base |= {
        "margin": {"l": 52, "r": 12, "t": TOP, "b": BOTTOM},
        "font": {"color": "var(--muted)", "size": 12},
    }
    return base | {"paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)"} | more


def panels(titles: Sequence[str], x_title: str, y_axes: Sequence[Spec]) -> Spec:
    """A layout of panels one below the other over one x axis; the first has axis `y`, then `y2` and so on."""
    rows = len(titles)
    inner = ROW * rows + GAP * (rows - 1)
    spec = layout(inner + TOP + BOTTOM, xaxis=axis(x_title, anchor=y_name(rows - 1)), annotations=[])
    for row, (title, extra) in enumerate(zip(titles, y_axes, strict=True)):
        top = 1 - row * (ROW + GAP) / inner
        own: Spec = {"domain": [max(top - ROW / inner, 0.0), top], "anchor": "x", "nticks": 5}
        spec["yaxis" + y_name(row)[1:]] = axis() | own | extra
        note = {
            "text": html.escape(title),
            "x": 0,
            "y": top,
            "xref": "paper",
            "yref": "paper",
            "showarrow": False,
        }
        note |= {"xanchor": "left", "yanchor": "bottom", "font": {"size": 12.5, "color": "var(--text)"}}
        spec["annotations"].append(note)
    return spec


def y_name(row: int) -> str:
    """The axis of a row, counted from 0."""
    return "y" if row == 0 else f"y{row + 1}"


def asinh_ticks(reach: float) -> Spec:
    """Ticks for an axis that carries asinh(value): 0, ± 2, and powers of ten up to sinh(reach)."""
    steps = [2.0] + [10.0**k for k in range(1, 12) if 10.0**k <= np.sinh(reach)]
    if len(steps) > 4:
        steps = [2.0, *steps[2::2]]
    values = [-step for step in reversed(steps)] + [0.0] + steps
    text = [f"{value:.0f}" if abs(value) < 1e4 else f"{value:.0e}".replace("e+0", "e") for value in values]
    text = [label.replace("-", "−") for label in text]
    return {"tickmode": "array", "tickvals": [float(v) for v in np.arcsinh(values)], "ticktext": text}
