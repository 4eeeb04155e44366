"""Ranking every effect by what its small change of the windows' predictions would gain beside psi."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.window_fit import FARTHEST_MOVE, WindowFit, steady
from det2stoc_bayes.mismatch.effects.base import PlacedEffect, Trial

SIZES = (1.0, 5.0, 20.0, 100.0)  # times the columns of smooth systems: contact is smooth over some of them
NUM_PROBES = 4  # trials by which an effect of more of them has its size chosen
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
    others: tuple["Promise", ...] = ()  # of the same effect's other trials, best first


def screen(
    fit: WindowFit, pool: Sequence[PlacedEffect], advance: Callable[[int], None] = lambda _: None
) -> list[Promise]:
    """Every candidate's best trial, most gain first."""
    few = fit.only(np.arange(0, fit.windows.count, EVERY))
    out = []
    for placed in pool:
        found = [_judged(fit, placed, *t) for t in _sifted(few, placed)]
        advance(1)
        if there := sorted((p for p in found if p is not None), key=lambda p: -p.gain):
            out.append(replace(there[0], others=tuple(there[1:])))
    return sorted(out, key=lambda p: -p.gain)


def _sifted(few: WindowFit, placed: PlacedEffect) -> list[tuple[Trial, float]]:
    """An effect's trials, and how many times as large as in smooth systems their columns are to be tried.

    Both by what they promise on a few windows; where columns are many, only trials that promise most there. A small
    change is lost in the chaos of contact, under which predictions never agree, and moves nothing that sticks.
    """
    trials = list(placed.effect.trials(placed.typical))
    sizes = SIZES
    if len(trials) > NUM_PROBES:
        probes = [trials[k] for k in np.linspace(0, len(trials) - 1, NUM_PROBES).astype(int)]
        told = [max(_glimpsed(few, placed, t, (size,))[0] for t in probes) for size in SIZES]
        sizes = (SIZES[int(np.argmax(told))],)
    found = [_glimpsed(few, placed, t, sizes) for t in trials]
    out = [(t, size) for t, (_, size) in zip(trials, found, strict=True)]
    if sum(len(t.columns) for t in trials) <= MANY:
        return out
    return [out[k] for k in np.argsort([-gain for gain, _ in found], kind="stable")[:SIFTED]]


def _glimpsed(few: WindowFit, placed: PlacedEffect, trial: Trial, sizes: Sequence[float]) -> tuple[float, float]:
    """The most that a trial promises by differences to one side, and at which size; of full size it stays as it is."""
    sizes = sizes if trial.sd > 1 else (1.0,)
    columns = [np.moveaxis(_changed(few, placed, trial, size), 0, -1) for size in sizes]
    told = [_promised(few, placed, trial, c, size).gain for c, size in zip(columns, sizes, strict=True)]
    return max(zip(told, sizes, strict=True), key=lambda pair: pair[0])


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
