"""Rivals that predict what an effect predicts, refined from where its fit ended.

From the believed model, far away, the same curve may be reached under one name and missed under another.
"""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import by_chance, effective_share, log_evidence
from det2stoc_bayes.mismatch.race import Ranked, Slot, allowed, gain, tolerance
from det2stoc_bayes.mismatch.screen import Screened, one_sided
from det2stoc_bayes.optimize import fit_many
from det2stoc_bayes.problem import Problem

KIN = 0.98  # share of an effect's squared response that a rival's columns take up
AKIN = 0.9  # that is enough where the effect leaves more than chance
RELATED = 0.7  # and beside other effects: without this one they may be anywhere, as may rivals that start from there
MOST = 4  # rivals that start anew


def with_kin(slot: Slot, own: Ranked) -> Slot:
    """The slot, its rivals of the same response fitted from the effect's own fit where that tells more."""
    share, fits = effective_share(own.fit), {r.placed: r.fit for r in slot.ranked}
    there = log_evidence(own.fit, share)
    starts = [
        start for placed, start in _starts(slot, own) if placed not in fits or log_evidence(fits[placed], share) < there
    ][:MOST]
    if not starts:
        return slot
    found = [f for f in fit_many(starts, tolerance=tolerance(own.fit)) if f is not None]
    for f in found:
        placed = f.problem.effects[-1]
        better = placed not in fits or log_evidence(f, share) > log_evidence(fits[placed], share)
        if better and allowed(f, len(slot.base.problem.effects)):
            fits[placed] = f
    ranked = [Ranked(placed, f, gain(slot.base, f, share)) for placed, f in fits.items()]
    return replace(slot, ranked=tuple(sorted(ranked, key=lambda r: -r.gain)))


def _starts(slot: Slot, own: Ranked) -> list[tuple[PlacedEffect, tuple[Problem, Point]]]:
    """Kin, closest first, each with its hypothesis and the effect's own unknowns beside matching ones of its own."""
    mine = next((s for s in slot.screened if s.placed == own.placed), None)
    if mine is None or mine.response is None:
        return []
    wanted = (mine.response @ mine.coefficients).ravel()
    least, found = RELATED if slot.base.problem.effects else KIN if by_chance(own.fit) else AKIN, []
    for s in slot.screened:
        if s.placed != own.placed:
            share, trial, coefficients = max((_matched(t, wanted) for t in (s, *s.others)), key=lambda m: m[0])
            if share > least:
                found.append((share, s.placed, _start(own, trial, coefficients)))
    return [(placed, start) for _, placed, start in sorted(found, key=lambda f: -f[0])]


def _matched(trial: Screened, wanted: np.ndarray) -> tuple[float, Screened, np.ndarray]:
    """The share of a response that a trial's columns take up, and their coefficients."""
    total = float(wanted @ wanted)
    if trial.response is None or not total:
        return 0.0, trial, np.zeros(0)
    x = trial.response.reshape(len(wanted), -1)
    coefficients = np.linalg.lstsq(x, wanted, rcond=None)[0]
    if (coefficients[one_sided(trial.placed, trial.trial)] < 0).any():
        return 0.0, trial, coefficients
    rest = wanted - x @ coefficients
    return 1.0 - float(rest @ rest) / total, trial, coefficients


def _start(own: Ranked, s: Screened, coefficients: np.ndarray) -> tuple[Problem, Point]:
    fit, effect, typical = own.fit, s.placed.effect, s.placed.typical
    values = effect.combine(s.trial, coefficients, typical)
    block = np.maximum(effect.to_normal(values, typical), effect.floor(typical))
    z = np.concatenate([fit.point.z[: fit.problem.size - own.placed.size], block])
    return fit.problem.with_effects((*fit.problem.effects[:-1], s.placed)), Point(z, fit.point.start)
