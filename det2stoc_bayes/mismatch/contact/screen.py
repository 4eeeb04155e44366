"""Ranking every effect by what its small change of the predictions would gain beside psi."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.mismatch.changes import Values, of_constants
from det2stoc_bayes.mismatch.contact.differences import steady
from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.followed import FARTHEST
from det2stoc_bayes.mismatch.contact.led_response import LedResponse, foretells
from det2stoc_bayes.mismatch.contact.regions import likeliest_border
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.effects.base import PlacedEffect, Trial
from det2stoc_bayes.mismatch.screen import one_sided
from det2stoc_bayes.mismatch.sharpen import leads, sharpened, unlike

SIZES = (1.0, 10.0, 100.0)  # times the columns of smooth systems: contact is smooth over some of them
WIDE = (10.0, 100.0)  # times, of what is to first order: small ones end within a contact's kink
SOME = 3  # one of so many recordings is looked at where it takes simulations, and has its say as often
KEPT = 2  # trials of an effect that are kept
NUM_STARTS = 4  # of them, from which a pattern search sets out,
NUM_SHARPENED = 12  # of so many candidates
MORE = 1.1  # times as much as before, beside a leader, that a second look must promise
MOST_HELD = 2_000_000  # numbers of what trials change that are held at once

type Tried = tuple["Promise", Trial]
type Tell = Callable[[PlacedEffect, Sequence[Values]], Float[np.ndarray, "blocks samples columns values"]]


@dataclass(frozen=True, eq=False)
class Promise:
    """An effect's best trial: what it would gain (nats) and where it would stand."""

    placed: PlacedEffect
    gain: float
    values: dict[str, Any]  # of the effect's parameters
    change: Float[np.ndarray, " size"]  # of the unknowns that are there
    others: tuple["Promise", ...] = ()  # of the same effect's other trials, best first


def screen(
    fit: ContactFit, pool: Sequence[PlacedEffect], advance: Callable[[int], None] = lambda _: None
) -> list[Promise]:
    """Every candidate's best trials, most gain first.

    Most are judged to first order by all recordings. What first order does not tell is simulated over some of those
    that are told badly and well, by the believed integration: a finer one takes several times as long; it changes what
    is foretold, but hardly what an effect does to it.
    """
    few, led = some(fit), LedResponse(fit)
    share = fit.problem.segments.count / few.problem.segments.count

    def promised(placed: PlacedEffect) -> Promise | None:
        if foretells(placed):
            found = _foretold(fit, led, placed)
        else:
            found = [replace(p, gain=share * p.gain) for p in _judged(few, placed)]
        found = sorted([*_bordered(fit, placed), *found], key=lambda p: -p.gain)
        return replace(found[0], others=tuple(found[1:])) if found else None

    for shared in (fit, few):
        shared.prepare()
    found = side_by_side(fit.problem, promised, pool, lambda k: advance(int(k > 0)))
    advance(int(len(pool) > 0))
    ranked = sorted((p for p in found if p is not None), key=lambda p: -p.gain)
    ranked[:NUM_SHARPENED] = side_by_side(fit.problem, partial(_sharpened, fit, led), ranked[:NUM_SHARPENED])
    return sorted(ranked, key=lambda p: -p.gain)


def promising_more(leader: PlacedEffect, before: Sequence[Promise], now: Sequence[Promise]) -> list[Promise]:
    """Those of a second look that promise more, beside what its leader does, than in the first one."""

    def beside(looked: Sequence[Promise]) -> dict[PlacedEffect, float]:
        gains = {s.placed: s.gain for s in looked}
        return {placed: gain / max(gains.get(leader, 0.0), 1e-9) for placed, gain in gains.items()}

    first, second = beside(before), beside(now)
    return [s for s in now if second[s.placed] > MORE * first[s.placed]]


def _bordered(fit: ContactFit, placed: PlacedEffect) -> list[Promise]:
    """What an effect that has a region promises, psi staying."""
    border = likeliest_border(fit, placed)
    if border is None:
        return []
    return [Promise(placed, border.gain, border.values, np.zeros(len(fit.z)))]


def told_worst(fit: ContactFit) -> Int[np.ndarray, " recordings"]:
    """Recordings in the order of how badly they are told."""
    told = fit.losses.reshape(fit.problem.segments.count, -1).sum(1)
    return np.argsort(-told, kind="stable")


def some(fit: ContactFit) -> ContactFit:
    """The fit on those recordings that are looked at first."""
    order = told_worst(fit)
    return fit.only(np.sort(order[::SOME]))


def _foretold(fit: ContactFit, led: LedResponse, placed: PlacedEffect) -> list[Promise]:
    """What trials promise to first order; best first, each by its best size."""
    trials, room = list(placed.effect.trials(placed.typical)), at_once(led)
    if of_constants(placed):
        sized = [(t, size) for t in trials for size in _sizes(placed, t, WIDE)]
        each = _to_both_sides(fit, led.lessened, placed, sized, room)
        of_trial = [[p for p, (t, _) in zip(each, sized, strict=True) if t is trial] for trial in trials]
        found = [max(mine, key=lambda p: p.gain) for mine in of_trial]
    else:
        found = _tried(fit, led, placed, trials)
    return sorted(found, key=lambda p: -p.gain)[:KEPT]


def at_once(led: LedResponse) -> int:
    """Columns of what changes that are told together."""
    return max(MOST_HELD // led.held, 1)


def _tried(fit: ContactFit, led: LedResponse, placed: PlacedEffect, trials: Sequence[Trial]) -> list[Promise]:
    """What each promises to first order, by columns as they are."""
    changes = _changes(led.lessened, placed, [(t, 1.0) for t in trials], at_once(led))
    return [_promised(fit, placed, t, own, 1.0) for t, own in zip(trials, changes, strict=True)]


def _sharpened(fit: ContactFit, led: LedResponse, promise: Promise) -> Promise:
    """The best of what is promised, and of where a pattern search leads from the best trials that are unlike others."""
    placed = promise.placed
    leading = [t for t in placed.effect.trials(placed.typical) if leads(placed, t)] if foretells(placed) else []
    if not leading:
        return promise

    def judged(trials: Sequence[Trial]) -> list[Tried]:
        return list(zip(_tried(fit, led, placed, trials), trials, strict=True))

    def gain(tried: Tried) -> float:
        return tried[0].gain

    def about(tried: Tried, reach: float) -> list[Tried]:
        return judged(placed.effect.about(tried[1], placed.typical, reach))

    def change(tried: Tried) -> Float[np.ndarray, " values"]:
        return fit.weighed(led.lessened(placed, [tried[0].values])).ravel() if gain(tried) > 0 else np.zeros(1)

    starts = unlike(sorted(judged(leading), key=gain, reverse=True), change, NUM_STARTS)
    sharp = sorted((sharpened(s, about, gain) for s in starts), key=gain, reverse=True)
    found = [*(p for p, _ in unlike(sharp, change, KEPT)), promise, *promise.others]
    best, *others = sorted(found, key=lambda p: -p.gain)[: KEPT + 1]
    return replace(best, others=tuple(replace(p, others=()) for p in others))


def _judged(few: ContactFit, placed: PlacedEffect) -> list[Promise]:
    """What trials promise that are simulated; best first."""
    tell = partial(_simulated, few)
    found = _to_both_sides(few, tell, placed, _sized(few, tell, placed))
    return sorted(found, key=lambda p: -p.gain)


def _sizes(placed: PlacedEffect, trial: Trial, sizes: Sequence[float]) -> Sequence[float]:
    """How many times as large a trial's columns are tried; what is not scalable stays so."""
    return sizes if _scalable(placed, trial) else (1.0,)


def _sized(fit: ContactFit, tell: Tell, placed: PlacedEffect) -> list[tuple[Trial, float]]:
    """The trials that promise most by differences to one side, each by its best size."""
    trials = list(placed.effect.trials(placed.typical))
    each = [_sizes(placed, t, SIZES) for t in trials]
    sized = [(t, size) for t, mine in zip(trials, each, strict=True) for size in mine]
    changes = _changes(tell, placed, sized)
    gains = iter([_promised(fit, placed, t, up, size).gain for (t, size), up in zip(sized, changes, strict=True)])
    best = [max((next(gains), size) for size in mine) for mine in each]
    order = sorted(range(len(trials)), key=lambda k: -best[k][0])
    return [(trials[k], best[k][1]) for k in order][:KEPT]


def _to_both_sides(
    fit: ContactFit, tell: Tell, placed: PlacedEffect, sized: Sequence[tuple[Trial, float]], room: int = MOST_HELD
) -> list[Promise]:
    """What trials of these sizes promise by differences to both sides; to one where they are not scalable."""
    apart = [(t, s * (2.0 if _wall(placed, t) else -1.0)) for t, s in sized if _scalable(placed, t)]
    changes = list(_changes(tell, placed, [*sized, *apart], room))
    other, out = iter(changes[len(sized) :]), []
    for (trial, size), up in zip(sized, changes, strict=False):
        if _scalable(placed, trial):
            away = next(other)
            up = steady(up, away - up if _wall(placed, trial) else -away)
        out.append(_promised(fit, placed, trial, up, size))
    return out


def _scalable(placed: PlacedEffect, trial: Trial) -> bool:
    """Whether a trial's columns may be larger or smaller: not of a narrow prior, nor of what is absent at no number."""
    return bool(trial.sd > 1 and np.isfinite(placed.effect.parameters[0].absent))


def _wall(placed: PlacedEffect, trial: Trial) -> bool:
    """Whether less than nothing of it cannot be."""
    return placed.effect.parameters[0].positive or trial.one_sided


def _changes(
    tell: Tell, placed: PlacedEffect, sized: Sequence[tuple[Trial, float]], room: int = MOST_HELD
) -> Iterator[Float[np.ndarray, "blocks samples columns size"]]:
    """By how much each trial's columns, so many times as large, lessen the errors; so many columns are told at once."""
    while sized:
        some = sized[: max(room // max(len(t.columns) for t, _ in sized), 1)]
        sized = sized[len(some) :]
        moved = tell(placed, [_enlarged(placed, column, size) for trial, size in some for column in trial.columns])
        ends = np.cumsum([len(trial.columns) for trial, _ in some])
        yield from np.split(moved, ends[:-1], axis=-1)


def _simulated(
    fit: ContactFit, placed: PlacedEffect, tried: Sequence[Values]
) -> Float[np.ndarray, "blocks samples columns values"]:
    """By how much an effect of each of these parameter values lessens the errors."""
    plain = fit.as_believed
    with np.errstate(all="ignore"):
        errors = plain.followed.errors_with(fit.z, placed, tried)
        stays = np.maximum(np.abs(plain.errors), np.abs(errors)) < FARTHEST  # a simulation that diverges tells nothing
        return np.moveaxis(np.where(stays, plain.errors - errors, 0.0), 0, -1)


def _promised(fit: ContactFit, placed: PlacedEffect, trial: Trial, columns: np.ndarray, factor: float) -> Promise:
    """The gain of one Gauss-Newton step beside psi."""
    beside, share = fit.beside(fit.weighed(columns))
    sd = trial.sd / factor
    inner = np.einsum("wnk,wnl->kl", beside, beside) + np.eye(beside.shape[2]) / sd**2
    total = np.einsum("wnk,wn->k", beside, fit.left)
    step = np.linalg.solve(inner, total)
    step = np.where(one_sided(placed, trial), np.maximum(step, 0.0), step)
    gain, change = float(step @ total - 0.5 * step @ inner @ step), -share @ step
    if not gain > 0:
        return Promise(placed, 0.0, dict(trial.columns[0]), np.zeros(len(fit.z)))
    return Promise(placed, gain, placed.effect.combine(trial, step * factor, placed.typical), change)


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
