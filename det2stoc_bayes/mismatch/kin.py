"""Rivals that predict what an effect predicts, refined from where its fit ended.

From the believed model, far away, the same curve may be reached under one name and missed under another.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.changes import changes
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import by_chance, effective_share, log_evidence
from det2stoc_bayes.mismatch.put_back import put_back
from det2stoc_bayes.mismatch.race import Ranked, Slot, added, allowed, gain, tolerance
from det2stoc_bayes.mismatch.screen import Beside, Screened, one_sided
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.problem import Problem

KIN = 0.98  # share of an effect's squared response that a rival's columns take up
AKIN = 0.9  # that is enough where the effect leaves more than chance
RELATED = 0.7  # and beside other effects: without this one they may be anywhere, as may rivals that start from there
MOST = 4  # rivals that start anew
SOON, NEAR = 2, 4.0  # iterations, and the noise inflation that must be reached by then
MOST_SIMPLER = 12  # that are looked at


def with_kin(slot: Slot, own: Ranked) -> Slot:
    """The slot, its rivals of the same response fitted from the effect's own fit where that tells more."""
    share, fits = effective_share(own.fit), {r.placed: r.fit for r in slot.ranked}
    there = log_evidence(own.fit, share)
    enough = {placed for placed, fit in fits.items() if log_evidence(fit, share) >= there}
    alike = [start for placed, start in _starts(slot, own) if placed not in enough]
    cases = {placed: start for placed, start in _special_cases(slot, own).items() if placed not in enough}
    simpler = [start for _, start in _simpler(slot, own, {*enough, *cases})]
    starts = [*cases.values(), *alike[:MOST], *simpler[:MOST]]
    if not starts:
        return slot
    for f in _fitted(starts, own):
        placed = f.problem.effects[-1]
        better = placed not in fits or log_evidence(f, share) > log_evidence(fits[placed], share)
        if better and allowed(f, len(slot.base.problem.effects)):
            fits[placed] = f
    ranked = [Ranked(placed, f, gain(slot.base, f, share)) for placed, f in fits.items()]
    return replace(slot, ranked=tuple(sorted(ranked, key=lambda r: -r.gain)))


def _fitted(starts: Sequence[tuple[Problem, Point]], own: Ranked) -> list[Fit]:
    """Fits from there; beside one that leaves but chance, what soon does not come near the noise is no kin."""
    ends = tolerance(own.fit)
    if not by_chance(own.fit):
        return [f for f in fit_many(starts, tolerance=ends) if f is not None]
    first = [f for f in fit_many(starts, max_iterations=SOON, tolerance=ends) if f is not None]
    on = [f for f in first if f.end == "unfinished" and f.noise_inflation < NEAR]
    further = fit_many([(f.problem, f.point) for f in on], tolerance=ends) if on else []
    better = {id(f): g for f, g in zip(on, further, strict=True) if g is not None}
    return [better.get(id(f), f) for f in first]


def _simpler(
    slot: Slot, own: Ranked, enough: Collection[PlacedEffect] = ()
) -> list[tuple[PlacedEffect, tuple[Problem, Point]]]:
    """Effects of fewer parameters that take an effect's place where its fit ended, closest first, from there.

    Under a large misfit, far from there, what has more parameters may promise so much more that they were not fitted.
    Those in `enough`, which were, are passed over: every look costs simulations.
    """
    worth = [s.placed for s in slot.screened if s.placed.size < own.placed.size and s.gain > 0][:MOST_SIMPLER]
    worth = [placed for placed in worth if placed not in enough]
    if not worth:
        return []
    bare = put_back(own.fit)
    beside, best = Beside(bare), {}
    for placed, trial, columns in changes(own.fit, worth, lambda n: None):
        found = beside.judge(placed, trial, columns)
        if found is not None and (placed not in best or found.gain > best[placed].gain):
            best[placed] = found
    least = (KIN if by_chance(own.fit) else AKIN) * beside.gain(own.fit)
    near = sorted((s for s in best.values() if s.gain > least), key=lambda s: -s.gain)
    return [(s.placed, added(bare, s.change, [(s, s.coefficients)])) for s in near]


def _special_cases(slot: Slot, own: Ranked) -> dict[PlacedEffect, tuple[Problem, Point]]:
    """Those of the effect on its element, its other unknowns as its fit has them.

    After impacts responses are far from linear: that one predicts the same is known by law, and not seen by columns.
    """
    values = {k: v[0] for k, v in own.fit.problem.effect_values(own.fit.point.z[None])[-1].items()}
    cases = own.placed.effect.special_cases(values)
    here = [s.placed for s in slot.screened if s.placed.element == own.placed.element]
    return {p: _instead(own, [(p, cases[p.effect.name])]) for p in here if p.effect.name in cases}


def truer_pair(slot: Slot, own: Ranked, needed: float) -> Fit | None:
    """Two effects in place of one that explains all but something beyond chance; None where no two leave chance alone.

    A spring is what a wrong gravity and a constant force do to small swings: alone it comes first, and next to nothing
    is left that could be added to it.
    """
    starts = [start for _, start in sorted(_pair_starts(slot, own), key=lambda s: -s[0])][:MOST]
    found = [f for f in fit_many(starts, tolerance=tolerance(own.fit)) if f is not None] if starts else []
    first, share = len(slot.base.problem.effects), effective_share(own.fit)
    truer = [f for f in found if allowed(f, first) and by_chance(f) and gain(own.fit, f, share) > needed]
    return max(truer, key=lambda f: gain(own.fit, f, share), default=None)


def _pair_starts(slot: Slot, own: Ranked) -> list[tuple[float, tuple[Problem, Point]]]:
    """Pairs that take up an effect's response, by how much, each with its hypothesis where that effect's fit ended."""
    wanted = _wanted(slot, own)
    if wanted is None:
        return []
    rivals = [s for s in slot.screened if s.placed != own.placed]
    # What takes up the response by itself is kin alone: beside it a second effect would be a passenger.
    rivals = [s for s in rivals if max(_taken_up(wanted, t)[0] for t in (s, *s.others)) <= KIN]
    trials = [t for s in rivals for t in (s, *s.others) if t.response is not None]
    found: dict[frozenset[PlacedEffect], tuple[float, tuple[Problem, Point]]] = {}
    for a, b in combinations(trials, 2):
        share, coefficients = _taken_up(wanted, a, b) if a.placed != b.placed else (0.0, np.zeros(0))
        key = frozenset((a.placed, b.placed))
        if share > max(KIN, found[key][0] if key in found else 0.0):
            found[key] = share, _start(own, [a, b], np.split(coefficients, [len(a.trial.columns)]))
    return list(found.values())


def _starts(slot: Slot, own: Ranked) -> list[tuple[PlacedEffect, tuple[Problem, Point]]]:
    """Kin, closest first, each with its hypothesis and the effect's own unknowns beside matching ones of its own."""
    wanted = _wanted(slot, own)
    if wanted is None:
        return []
    least, found = RELATED if slot.base.problem.effects else KIN if by_chance(own.fit) else AKIN, []
    for s in slot.screened:
        if s.placed != own.placed:
            matched = [(*_taken_up(wanted, t), t) for t in (s, *s.others)]
            share, coefficients, trial = max(matched, key=lambda m: m[0])
            if share > least:
                found.append((share, s.placed, _start(own, [trial], [coefficients])))
    return [(placed, start) for _, placed, start in sorted(found, key=lambda f: -f[0])]


def _wanted(slot: Slot, own: Ranked) -> Float[np.ndarray, " values"] | None:
    """An effect's response, where screening kept it."""
    mine = next((s for s in slot.screened if s.placed == own.placed), None)
    return None if mine is None or mine.response is None else (mine.response @ mine.coefficients).ravel()


def _taken_up(wanted: Float[np.ndarray, " values"], *trials: Screened) -> tuple[float, Float[np.ndarray, " columns"]]:
    """The share of a response that trials' columns take up together, and their coefficients."""
    total, responses = float(wanted @ wanted), [t.response for t in trials if t.response is not None]
    if not total or len(responses) < len(trials):
        return 0.0, np.zeros(0)
    x = np.concatenate([r.reshape(len(wanted), -1) for r in responses], 1)
    coefficients = np.linalg.lstsq(x, wanted, rcond=None)[0]
    positive = np.concatenate([one_sided(t.placed, t.trial) for t in trials])
    if (coefficients[positive] < 0).any():
        return 0.0, coefficients
    rest = wanted - x @ coefficients
    return 1.0 - float(rest @ rest) / total, coefficients


def _start(
    own: Ranked, trials: Sequence[Screened], coefficients: Sequence[Float[np.ndarray, " columns"]]
) -> tuple[Problem, Point]:
    """The hypothesis with trials in an effect's place, its other unknowns as its fit has them."""
    combined = [
        (s.placed, s.placed.effect.combine(s.trial, values, s.placed.typical))
        for s, values in zip(trials, coefficients, strict=True)
    ]
    return _instead(own, combined)


def _instead(own: Ranked, others: Sequence[tuple[PlacedEffect, Mapping[str, Any]]]) -> tuple[Problem, Point]:
    """The hypothesis with others of these values in an effect's place, the other unknowns as its fit has them."""
    fit = own.fit
    blocks = [np.maximum(p.effect.to_normal(v, p.typical), p.effect.floor(p.typical)) for p, v in others]
    z = np.concatenate([fit.point.z[: fit.problem.size - own.placed.size], *blocks])
    problem = fit.problem.with_effects((*fit.problem.effects[:-1], *(p for p, _ in others)))
    return problem, Point(z, fit.point.start)
