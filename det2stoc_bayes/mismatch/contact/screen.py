"""Ranking every effect by what its small change of the windows' predictions would gain beside psi."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.window_fit import FARTHEST_MOVE, WindowFit, steady
from det2stoc_bayes.mismatch.effects.base import PlacedEffect, Trial

LARGER = 20.0  # times the columns of smooth systems: finite differences over which contact is smooth enough
MUCH, MOVED = 1.5, 0.95  # error scales by which a column may change this quantile of windows
MANY = 16  # columns of an effect whose trials are first sifted,
SIFTED = 4  # of which the best so many are tried on all windows,
EVERY = 4  # and the others on every so many, by differences to one side


@dataclass(frozen=True, eq=False)
class Promise:
    """An effect's best trial: what it would gain (nats) and where it would stand."""

    placed: PlacedEffect
    gain: float
    values: dict[str, Any]  # of the effect's parameters
    change: Float[np.ndarray, " size"]  # of the unknowns that are there
    moves: Float[np.ndarray, "windows states"]  # of the starts, in their sds


def screen(
    fit: WindowFit, pool: Sequence[PlacedEffect], advance: Callable[[int], None] = lambda _: None
) -> list[Promise]:
    """Every candidate's best trial, most gain first."""
    few = fit.only(np.arange(0, fit.windows.count, EVERY))
    out = []
    for placed in pool:
        found = [_judged(fit, placed, *t) for t in _sifted(few, placed)]
        advance(1)
        if there := [p for p in found if p is not None]:
            out.append(max(there, key=lambda p: p.gain))
    return sorted(out, key=lambda p: -p.gain)


def _sifted(few: WindowFit, placed: PlacedEffect) -> list[tuple[Trial, float]]:
    """An effect's trials, and how many times as large as in smooth systems their columns are to be tried.

    Both by what they do to a few windows; where columns are many, only trials that promise most there.
    """
    out, gains = [], []
    for trial in placed.effect.trials(placed.typical):
        factor = 1.0 if trial.sd <= 1 else LARGER  # columns of full size are taken as they are
        up = _changed(few, placed, trial, factor)
        much = float(np.quantile((np.abs(up) / few.scales.values).max((2, 3)), MOVED, axis=1).max())
        smaller = 1.0 if trial.sd <= 1 else min(1.0, max(MUCH / max(much, 1e-12), 1 / LARGER))
        promise = _promised(few, placed, trial, np.moveaxis(up, 0, -1), factor)
        out.append((trial, factor * smaller))
        gains.append(promise.gain)
    if sum(len(t.columns) for t, _ in out) <= MANY:
        return out
    return [out[k] for k in np.argsort(gains)[::-1][:SIFTED]]


def _judged(fit: WindowFit, placed: PlacedEffect, trial: Trial, factor: float) -> Promise | None:
    up = _changed(fit, placed, trial, factor)
    if trial.sd > 1:
        wall = _wall(placed, trial)
        other = _changed(fit, placed, trial, factor * (2.0 if wall else -1.0))
        up = steady(up, other - up if wall else -other)
    columns = np.moveaxis(up, 0, -1)
    return _promised(fit, placed, trial, columns, factor) if columns.any() else None


def _wall(placed: PlacedEffect, trial: Trial) -> bool:
    """Whether less than nothing of it cannot be."""
    return placed.effect.parameters[0].positive or trial.one_sided


def _changed(
    fit: WindowFit, placed: PlacedEffect, trial: Trial, factor: float
) -> Float[np.ndarray, "size windows horizons columns"]:
    """By how much each of a trial's columns, so many times as large, lessens the errors."""
    with np.errstate(all="ignore"):
        moved = fit.windows.errors_with(fit.z, placed, [_enlarged(placed, c, factor) for c in trial.columns])
    return np.nan_to_num(fit.errors - moved)


def _promised(fit: WindowFit, placed: PlacedEffect, trial: Trial, columns: np.ndarray, factor: float) -> Promise:
    """The gain of one Gauss-Newton step beside psi and the starts."""
    raw, columns = columns, fit.beside.columns(columns)
    share = np.linalg.solve(fit.gram, np.einsum("wnk,wnl->kl", fit.told, columns))
    beside = columns - fit.told @ share
    sd = trial.sd / factor
    inner = np.einsum("wnk,wnl->kl", beside, beside) + np.eye(columns.shape[2]) / sd**2
    total = np.einsum("wnk,wn->k", beside, fit.left)
    step = np.linalg.solve(inner, total)
    if _wall(placed, trial):
        step = np.maximum(step, 0.0)
    gain, change = float(step @ total - 0.5 * step @ inner @ step), -share @ step
    if not gain > 0:
        return Promise(placed, 0.0, dict(trial.columns[0]), np.zeros(len(fit.z)), np.zeros_like(fit.away))
    moves = fit.beside.moves(fit.errors - raw @ step - fit.columns @ change)
    values = placed.effect.combine(trial, step * factor, placed.typical)
    return Promise(placed, gain, values, change, np.clip(moves, -FARTHEST_MOVE, FARTHEST_MOVE))


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
