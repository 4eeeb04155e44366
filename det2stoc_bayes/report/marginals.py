"""Posterior marginals before and after: one entry a scalar, with its table row and its density."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr
from arviz_stats.base.array import array_stats

from det2stoc_bayes.report import canvas, numbers
from det2stoc_bayes.report.canvas import Spec
from det2stoc_bayes.report.contents import words

EFFECT_PARAMETER = re.compile(r"(\w+)\[(.*)\]\.(.+)")
CHAINS = ("chain", "draw")
MAX_COMPONENTS = 12
BEYOND = 3  # bandwidths that a density goes beyond its outermost draws


@dataclass(frozen=True)
class Marginal:
    """Draws of one scalar; None where a group lacks it."""

    variable: str
    label: str
    unit: str
    before: np.ndarray | None = None
    after: np.ndarray | None = None
    prior: np.ndarray | None = None

    @property
    def title(self) -> str:
        """`Coulomb friction, wrist: force` for an effect's parameter, else the label as it is."""
        parts = EFFECT_PARAMETER.fullmatch(self.label)
        if parts is None:
            return self.label
        effect, element, parameter = parts.groups()
        said = f"{words(effect)}, {element.replace(':', '/')}: {words(parameter)}"
        return said[0].upper() + said[1:]

    def row(self, which: str) -> dict[str, str]:
        """Mean ± sd and 95 % interval, as text."""
        draws = getattr(self, which)
        if draws is None:
            return {"value": numbers.MISSING, "interval": numbers.MISSING}
        low, high = array_stats.eti(draws, 0.95)
        return {
            "value": numbers.plus_minus(float(draws.mean()), float(draws.std())),
            "interval": numbers.interval([float(low), float(high)]),
        }

    @property
    def shift(self) -> str:
        """How far the mean moved, in sds of the posterior before."""
        if self.before is None or self.after is None or not self.before.std() > 0:
            return numbers.MISSING
        moved = numbers.number(float((self.after.mean() - self.before.mean()) / self.before.std()), 2)
        return moved if moved.startswith("−") else f"+{moved}"


def marginals(fit: xr.DataTree) -> tuple[list[Marginal], list[Marginal]]:
    """Those of psi in both fits, and of the effects' parameters, `<effect>[<element>].<param>`."""
    draws = {which: _draws(fit, f"{which}/posterior") for which in ("before", "after")}
    prior = _draws(fit, "before/prior")
    psi, effects = [], []
    for key in [*draws["before"], *(key for key in draws["after"] if key not in draws["before"])]:
        variable, label, unit = key
        both = {which: found[key] for which, found in draws.items() if key in found}
        entry = Marginal(variable, label, unit, **both, prior=prior.get(key))
        (effects if "[" in variable and key not in draws["before"] else psi).append(entry)
    return psi, effects


def density_figure(marginal: Marginal, names: dict[str, str]) -> Spec:
    """Densities of one scalar before and after, and of its prior where the fit holds it."""
    every = {"prior": marginal.prior, "before": marginal.before, "after": marginal.after}
    shown = {which: draws for which, draws in every.items() if draws is not None and which in ("prior", *names)}
    bounds = _bounds(np.concatenate(list(shown.values())))
    curves = {which: _density(draws, *bounds) for which, draws in shown.items()}
    traces = []
    for which, (x, height) in curves.items():
        colour, prior = canvas.colour_of(which), which == "prior"
        filled: Spec = {"fill": "tozeroy", "fillcolor": canvas.soft(colour)}
        style: Spec = {"line": {"dash": "dot"}} if prior else filled
        traces.append(canvas.line(x, height, names.get(which, "prior"), colour, **style))
    fitted = [which for which in shown if which != "prior"]
    values = np.concatenate([curves[which][0] for which in fitted])
    low, high = float(values.min()), float(values.max())
    pad = 0.02 * (high - low) or 0.01 * abs(low) or 1e-9
    peak = 1.08 * max(float(curves[which][1].max()) for which in fitted)
    margin = {"l": 28, "r": 28, "t": 6, "b": 38 if marginal.unit else 26}
    x_axis = canvas.axis(marginal.unit, range=[low - pad, high + pad], nticks=4, tickangle=0)
    y_axis = {"visible": False, "range": [0, peak]}
    return {"data": traces, "layout": canvas.layout(190, margin=margin, xaxis=x_axis, yaxis=y_axis)}


def _bounds(draws: np.ndarray) -> tuple[float, float]:
    """Within which densities are drawn: draws of one sign alone are taken to be of what has one."""
    return 0.0 if draws.min() >= 0 else -np.inf, 0.0 if draws.max() <= 0 else np.inf


def _density(draws: np.ndarray, lowest: float, highest: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of the density's curve; a spike of height one where all draws are equal."""
    mean = float(draws.mean())
    if np.ptp(draws) <= 1e-9 * abs(mean):
        return np.array([mean, mean]), np.array([0.0, 1.0])
    # Few weighted points give many equal draws, which a bandwidth that counts them all would show as spikes.
    distinct = len(np.unique(draws))
    equal = {"bw": 0.9 * float(draws.std()) * distinct**-0.2} if distinct < len(draws) else {}
    width = equal.get("bw") or float(array_stats.kde(draws)[2])
    ends = max(draws.min() - BEYOND * width, lowest), min(draws.max() + BEYOND * width, highest)
    x, height = array_stats.kde(draws, bw=width, custom_lims=ends)[:2]
    return x[::2], height[::2]


def _draws(fit: xr.DataTree, group: str) -> dict[tuple[str, str, str], np.ndarray]:
    """Flat finite draws by (variable, label, unit), vectors component by component."""
    try:
        variables = fit[group].to_dataset().data_vars
    except KeyError:
        return {}
    found = {}
    for variable, data in variables.items():
        if not set(CHAINS) <= set(data.dims) or "recording" in data.dims:
            continue
        unit = str(data.attrs.get("unit", ""))
        for label, component in _components(str(variable), data):
            values = component.values.astype(float).ravel()
            values = values[np.isfinite(values)]
            if values.size > 1:
                found[str(variable), label, unit] = values
    return found


def _components(variable: str, data: xr.DataArray) -> Iterator[tuple[str, xr.DataArray]]:
    rest = [dim for dim in data.dims if dim not in CHAINS]
    if not rest:
        yield variable, data
        return
    stacked = data.stack(component=rest, create_index=False)
    for position in range(min(stacked.sizes["component"], MAX_COMPONENTS)):
        one = stacked.isel(component=position)
        places = [str(one[dim].item()) if dim in one.coords else "" for dim in rest]
        if not all(places):
            places = [str(place) for place in np.unravel_index(position, [data.sizes[dim] for dim in rest])]
        yield f"{variable} · {', '.join(places)}", one
