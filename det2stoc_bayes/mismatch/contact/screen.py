"""Ranking every effect by what its small change of the windows' predictions would gain beside psi."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from det2stoc_bayes.mismatch.contact.scales import scatter
from det2stoc_bayes.mismatch.contact.window_fit import WindowFit, bounded, steady
from det2stoc_bayes.mismatch.effects.base import PlacedEffect, Trial

LARGER = 20.0  # times the columns of smooth systems: finite differences over which contact is smooth enough
OVERLAP = 2.0  # windows that see the same sample
RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Promise:
    """An effect's best trial: what it would gain (nats), its tail probability by chance, and where it would stand."""

    placed: PlacedEffect
    gain: float
    tail: float
    values: dict[str, Any]  # of the effect's parameters
    change: Float[np.ndarray, " size"]  # of the unknowns that are there


def screen(
    fit: WindowFit, pool: Sequence[PlacedEffect], advance: Callable[[int], None] = lambda _: None
) -> list[Promise]:
    """Every candidate's best trial, most gain first."""
    out = []
    for placed in pool:
        found = [p for p in (_judged(fit, placed, t) for t in placed.effect.trials(placed.typical)) if p is not None]
        advance(1)
        if found:
            out.append(max(found, key=lambda p: p.gain))
    return sorted(out, key=lambda p: -p.gain)


def _judged(fit: WindowFit, placed: PlacedEffect, trial: Trial) -> Promise | None:
    effect, windows = placed.effect, fit.windows
    wall = effect.parameters[0].positive or trial.one_sided
    sizes = (1.0, 2.0) if wall else (1.0, -1.0)
    small = trial.sd > 1  # columns of full size are taken as they are
    factor, sizes = (LARGER, sizes) if small else (1.0, (1.0,))
    tried = [_enlarged(placed, column, factor * s) for s in sizes for column in trial.columns]
    with np.errstate(all="ignore"):
        e = windows.errors_with(fit.z, placed, tried)
    n = len(trial.columns)
    first, second = e[:n], e[n:]
    up = fit.errors - first
    if small:
        up = steady(up, first - second if wall else second - fit.errors)
    columns = np.moveaxis(np.nan_to_num(up), 0, -1)
    if not columns.any():
        return None
    return _test(fit, placed, trial, columns, factor, wall)


def _test(
    fit: WindowFit, placed: PlacedEffect, trial: Trial, columns: np.ndarray, factor: float, wall: bool
) -> Promise | None:
    """The score test with scatter over windows, and the gain of one Gauss-Newton step."""
    weight = fit.scales.weights(fit.errors) * bounded(columns)
    error = np.nan_to_num(fit.errors)
    psi = fit.columns
    gram = np.einsum("whc,whck,whcl->kl", weight, psi, psi) + np.eye(psi.shape[3])
    cross = np.einsum("whc,whck,whcl->kl", weight, psi, columns)
    share = np.linalg.solve(gram, cross)
    beside = columns - psi @ share
    sd = trial.sd / factor
    inner = np.einsum("whc,whck,whcl->kl", weight, beside, beside) + np.eye(columns.shape[3]) / sd**2
    pull = np.einsum("whc,whck,whc->wk", weight, beside, error)
    total = pull.sum(0)
    chi2 = float(total @ np.linalg.solve(scatter(pull, fit.windows.recording) + RIDGE * np.diag(np.diag(inner)), total))
    active = int((np.abs(beside).max((1, 2)) > 1e-3 * np.abs(beside).max((0, 1, 2))).any(1).sum())
    k, free = columns.shape[3], max(active / OVERLAP - columns.shape[3], 1.0)
    tail = float(stats.f.sf(chi2 * free / (max(active / OVERLAP, 1.0) * k), k, free)) if chi2 > 0 else 1.0
    step = np.linalg.solve(inner, total)
    if wall:
        step = np.maximum(step, 0.0)
    gain = float(step @ total - 0.5 * step @ inner @ step)
    if not gain > 0:
        return Promise(placed, 0.0, 1.0, dict(trial.columns[0]), np.zeros(len(fit.z)))
    values = placed.effect.combine(trial, step * factor, placed.typical)
    return Promise(placed, gain, tail, values, -share @ step)


def _enlarged(placed: PlacedEffect, column: Any, factor: float) -> dict[str, Any]:
    """A column's values, its parameters so many times as far from where the effect is absent."""
    first, *rest = placed.effect.parameters
    moved = np.any(np.asarray(column[first.name]) != first.absent)
    scaled = [first] if moved else [p for p in rest if np.any(np.asarray(column[p.name]) != p.absent)]
    out = dict(column)
    if factor == 1.0:
        return out
    for p in scaled:
        out[p.name] = p.absent + factor * (np.asarray(column[p.name], float) - p.absent)
    return out
