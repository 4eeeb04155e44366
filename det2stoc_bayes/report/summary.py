"""A posterior in one row a parameter: mean, sd, interval, and whether the draws can be trusted."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from arviz_stats.base.array import array_stats
from jaxtyping import Float

INTERVAL = (0.025, 0.975)


@dataclass(frozen=True)
class Row:
    """One scalar; `r_hat` is None where chains are no independent runs, as an ensemble's walkers."""

    name: str
    mean: float
    sd: float
    interval: tuple[float, float]
    r_hat: float | None
    ess: float | None


@dataclass(frozen=True)
class Told:
    """Mean log density of a held-out recording's transitions [nat], by three ways to count it."""

    recording: str
    num_transitions: int
    matched: float
    mixture: float
    one_latent: float


def predicted(fit: xr.DataTree) -> list[Told]:
    """Held-out recordings as a stochastic simulator tells them; none for other methods."""
    if "predictions" not in fit.children:
        return []
    told = fit.children["predictions"].to_dataset()
    names, counts = told["heldout"].values, told["num_transitions"].values
    columns = [told[f"log_density_{way}"].values for way in ("matched", "mixture", "one_latent")]
    return [Told(str(n), int(c), *map(float, row)) for n, c, *row in zip(names, counts, *columns, strict=True)]


def summarize(fit: xr.DataTree) -> list[Row]:
    """Every variable of the posterior group; further dimensions as `friction[drop_03]`."""
    if "posterior" not in fit.children:
        return []
    times, effective = _autocorrelation_times(fit), fit.attrs.get("effective_draws")
    return [_row(label, draws, times.get(label), effective) for _, label, draws in scalars(fit)]


def scalars(fit: xr.DataTree) -> Iterator[tuple[str, str, Float[np.ndarray, "_ _"]]]:
    """Variable, label (`friction[drop_03]` of a further dimension) and draws (chain, draw) of every scalar."""
    if "posterior" not in fit.children:
        return
    for name, data in fit.children["posterior"].to_dataset().data_vars.items():
        data = data.transpose("chain", "draw", ...)
        for index in np.ndindex(data.shape[2:]):
            labels = [str(data[d].values[i]) for d, i in zip(data.dims[2:], index, strict=True)]
            label = f"{name}[{', '.join(labels)}]" if labels else str(name)
            yield str(name), label, np.asarray(data.values[(slice(None), slice(None), *index)], float)


def _row(name: str, draws: np.ndarray, kept_per_time: float | None, effective: float | None) -> Row:
    """`effective`: what weights were worth by which draws were resampled in random order, which no chain shows."""
    low, high = np.quantile(draws, INTERVAL)
    if effective is not None:
        r_hat, ess = None, min(draws.size, effective)
    elif kept_per_time is None:
        r_hat = _number(array_stats.rhat(draws, chain_axis=0, draw_axis=1)) if draws.shape[0] > 1 else None
        ess = _number(array_stats.ess(draws, chain_axis=0, draw_axis=1))
    else:
        r_hat, ess = None, min(draws.size, draws.size * kept_per_time)
    return Row(name, float(draws.mean()), float(draws.std(ddof=1)), (float(low), float(high)), r_hat, ess)


def _autocorrelation_times(fit: xr.DataTree) -> dict[str, float]:
    """Variable -> steps between kept draws over the autocorrelation time, for samplers that report one."""
    stats = fit.children["sample_stats"].to_dataset()
    if "autocorrelation_time" not in stats:
        return {}
    names = [str(n) for n in fit.children["unconstrained_posterior"].to_dataset()["unknown"].values]
    step = float(stats["thinned_by"]) if "thinned_by" in stats else 1.0
    times = stats["autocorrelation_time"].values
    return {n: step / float(t) for n, t in zip(names, times, strict=True) if math.isfinite(t) and t > 0}


def _number(value: Any) -> float | None:
    """A finite number, or None (chains that are too short have neither figure)."""
    value = float(value)
    return value if math.isfinite(value) else None
