"""Hypotheses from where screening puts them: a sketch of each, and fits of those that stay in the race."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, by_chance, effective_share, log_evidence
from det2stoc_bayes.mismatch.screen import Screened
from det2stoc_bayes.optimize import Fit, fit_many, sketch
from det2stoc_bayes.problem import Problem

RACE = (10.0, 0.3, 50.0)  # how far behind the best sketch a candidate may be: nats, share of the gain, at most
NUM_LEADERS, MOST_ITERATIONS = 2, 15  # that go on to their optimum while a misfit remains
LEAST_GAIN = 7.0  # nats beyond the log number of candidates: below it an addition is chance
FURTHER, SOON = 5, 2  # iterations of those in the race, and of who went astray beside an explanation far ahead
AT_WALL = 1e-6  # prior sds from where a positive parameter is absent
SETTLED = 0.3  # nats that a further iteration may gain


@dataclass(frozen=True, eq=False)
class Ranked:
    """A refined candidate and the evidence it gains over the fit without it."""

    placed: PlacedEffect
    fit: Fit
    gain: float


@dataclass(frozen=True, eq=False)
class Slot:
    """One place in the list of effects: the fit without it and what could stand there, best first."""

    base: Fit
    screened: tuple[Screened, ...]
    ranked: tuple[Ranked, ...]


def threshold(num_candidates: int) -> float:
    """Evidence gain that an addition must reach, nats."""
    return LEAST_GAIN + float(np.log(max(num_candidates, 1)))


def standing(base: Fit, present: Fit | None) -> list[Fit]:
    """The fit of what stands in a place, where it is of the same samples."""
    if present is None or present.problem.segments.key != base.problem.segments.key:
        return []
    return [present]


def added(
    base: Fit, change: Float[np.ndarray, " size"], added: Sequence[tuple[Screened, Float[np.ndarray, "_"]]]
) -> tuple[Problem, Point]:
    """The hypothesis with screened additions, where screening puts it."""
    z = [np.maximum(base.problem.bent(base.point.z, change), base.problem.floor)]
    for s, coefficients in added:
        values = s.placed.effect.combine(s.trial, coefficients, s.placed.typical)
        z.append(s.placed.effect.to_normal(values, s.placed.typical))
    problem = base.problem.with_effects((*base.problem.effects, *(s.placed for s, _ in added)))
    return problem, Point(np.concatenate(z), base.point.start)


def race(
    base: Fit, points: Sequence[tuple[Problem, Point]], *, most: int | None = None, present: Fit | None = None
) -> list[Fit]:
    """Fits of several hypotheses; after a sketch of each only those (at most `most`) still in the race go on.

    A hypothesis may start from several points: its best fit is returned. A rival's fit `present` that leaves but
    chance runs, too.

    Positive parameters that end where the effect is absent drop their hypothesis.
    """
    if not points:
        return []
    first = len(base.problem.effects)
    fits = [f for f in sketch(base, points, tolerance=tolerance(base)) if f is not None]
    if not fits:
        return []
    others = standing(base, present)
    known = [f for f in others if by_chance(f)]
    ahead = min([*known, *(f for f in fits if allowed(f, first))] or fits, key=lambda f: f.chi2)
    share = effective_share(ahead)
    evidence, floor = {id(f): log_evidence(f, share) for f in fits}, log_evidence(base, share)
    top = max(*evidence.values(), log_evidence(ahead, share))
    explained = by_chance(ahead)
    behind = RACE[2] if explained else np.clip(RACE[1] * (top - floor), RACE[0], RACE[2])
    fits = sorted(fits, key=lambda f: -evidence[id(f)])[:most]
    # A sketch that ends below where it began went astray: it says nothing of the hypothesis. Beside who explains all
    # but chance, or stands far ahead in the place, it is given a little time; what predicts the same is looked for from
    # there, too (`kin`).
    told = explained or any(log_evidence(f, share) > floor + RACE[2] for f in others)
    racing = [f for f in fits if evidence[id(f)] > top - behind]
    astray = [f for f in fits if evidence[id(f)] < floor and f not in racing]
    better: dict[int, Fit] = {}
    for some, most_iterations in ((racing, FURTHER), (astray, SOON if told else FURTHER)):
        on = [(f.problem, f.point) for f in some]
        found = fit_many(on, max_iterations=most_iterations, tolerance=SETTLED / share) if some else []
        better |= {id(f): g for f, g in zip(some, found, strict=True) if g is not None}
    best: dict[tuple[PlacedEffect, ...], Fit] = {}
    for f in (better.get(id(f), f) for f in fits):
        rival = best.get(f.problem.effects)
        if allowed(f, first) and (rival is None or log_evidence(f, share) > log_evidence(rival, share)):
            best[f.problem.effects] = f
    if not explained:
        leaders = sorted(best.values(), key=lambda f: -log_evidence(f, share))[:NUM_LEADERS]
        best |= {f.problem.effects: f for f in settled(leaders, share, first)}
    return list(best.values())


def settled(fits: Sequence[Fit], share: float, first: int, least: float = MODEL_ERROR) -> list[Fit]:
    """Those on their way at their optima: under a large misfit a race ends long before that, and the slower may win.

    Those that leave `least` times the noise at least.
    """
    slow = [f for f in fits if f.end == "unfinished" and f.noise_inflation >= least]
    on = [(f.problem, f.point) for f in slow]
    found = fit_many(on, max_iterations=MOST_ITERATIONS, tolerance=SETTLED / share) if slow else []
    better = {
        id(f): g
        for f, g in zip(slow, found, strict=True)
        if g is not None and log_evidence(g, share) >= log_evidence(f, share) and allowed(g, first)
    }
    return [better.get(id(f), f) for f in fits]


def gain(base: Fit, fit: Fit, share: float) -> float:
    """Evidence that an addition earns, nats."""
    return log_evidence(fit, share) - log_evidence(base, share)


def tolerance(fit: Fit) -> float:
    """Gain at which iterations end; under model error a nat of correlated samples is worth less."""
    return SETTLED / effective_share(fit)


def allowed(fit: Fit, first: int) -> bool:
    """Whether no parameter of the effects from `first` on ended at the wall that keeps it positive."""
    begin = fit.problem.num_psi + sum(e.size for e in fit.problem.effects[:first])
    return bool((fit.point.z > fit.problem.floor + AT_WALL)[begin:].all())
