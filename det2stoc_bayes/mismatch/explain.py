"""From a misfit to the effects that remove it: screen, refine, add the best, again, then look back at each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import effective_share, log_evidence, log_told
from det2stoc_bayes.mismatch.horizon import extend
from det2stoc_bayes.mismatch.pairs import pairs, varied
from det2stoc_bayes.mismatch.screen import Screened, screen
from det2stoc_bayes.optimize import Fit, fit_many, sketch, summarize
from det2stoc_bayes.problem import Problem

NUM_REFINED = 5
NUM_OTHERS = 3
NUM_PAIRS = 6
PROMISING = 0.3  # of the best screened evidence: what earns less is not refined
RACE = 50.0  # nats behind the best after a sketch at which a candidate is no longer refined
LEAST_GAIN = 7.0  # nats beyond the log number of candidates: below it an addition is chance
AT_WALL = 1e-6  # prior sds from where a positive parameter is absent
SETTLED = 0.3  # nats that a further iteration may gain
MAX_EFFECTS = 3
Progress = Callable[[str, int, int], None]  # stage, done, total


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


@dataclass(frozen=True, eq=False)
class Explanation:
    """The believed model's fit, the fit with all effects, and a slot for each of them."""

    before: Fit
    after: Fit
    slots: tuple[Slot, ...]
    num_candidates: int
    share: float  # independent samples per sample


def threshold(num_candidates: int) -> float:
    """Evidence gain that an addition must reach, nats."""
    return LEAST_GAIN + float(np.log(max(num_candidates, 1)))


def look(base: Fit, pool: Sequence[PlacedEffect], progress: Progress) -> Slot:
    """Screen every candidate beside a fit and refine those that may earn their place."""
    count = [0]

    def advance(n: int) -> None:
        count[0] += n
        progress("screening effects", count[0], len(pool))

    screened = screen(base, pool, advance)
    best = screened[0].log_evidence if screened else 0.0
    least = max(PROMISING * best, threshold(len(pool)) / 3)
    worth = _shortlist([s for s in screened if s.log_evidence > least])
    return Slot(base, tuple(screened), tuple(refine(base, worth, progress)))


def _shortlist(worth: Sequence[Screened]) -> list[Screened]:
    """The best, and the best of effects that are not among them: the same law on other elements crowds others out."""
    first = list(worth[:NUM_REFINED])
    names = {s.placed.effect.name for s in first}
    for s in worth[NUM_REFINED:]:
        if s.placed.effect.name not in names and len(first) < NUM_REFINED + NUM_OTHERS:
            first.append(s)
            names.add(s.placed.effect.name)
    return first


def refine(base: Fit, worth: Sequence[Screened], progress: Progress) -> list[Ranked]:
    """Joint Gauss-Newton of psi and each candidate, best evidence first."""
    progress("refining the best", 0, len(worth))
    points = [_added(base, s.change, [(s, s.coefficients)]) for s in worth]
    fits = race(base, points)
    progress("refining the best", len(worth), len(worth))
    if not fits:
        return []
    share = effective_share(min(fits, key=lambda f: f.chi2))
    ranked = (Ranked(f.problem.effects[-1], f, gain(base, f, share)) for f in fits)
    return sorted(ranked, key=lambda r: -r.gain)


def refine_pairs(base: Fit, screened: Sequence[Screened], least: float) -> Fit | None:
    """The best fit with two additions at once, if its screening promises more than `least` nats."""
    worth = varied([p for p in pairs(base, screened) if p.log_evidence > least], NUM_PAIRS)
    points = [_added(base, p.change, list(zip(p.members, p.coefficients, strict=True))) for p in worth]
    fits = race(base, points)
    if not fits:
        return None
    share = effective_share(min(fits, key=lambda f: f.chi2))
    return max(fits, key=lambda f: gain(base, f, share))


def _added(
    base: Fit, change: Float[np.ndarray, " size"], added: Sequence[tuple[Screened, Float[np.ndarray, "_"]]]
) -> tuple[Problem, Point]:
    """The hypothesis with screened additions, where screening puts it."""
    z = [base.problem.bent(base.point.z, change)]
    for s, coefficients in added:
        values = s.placed.effect.combine(s.trial, coefficients, s.placed.typical)
        z.append(s.placed.effect.to_normal(values, s.placed.typical))
    problem = base.problem.with_effects((*base.problem.effects, *(s.placed for s, _ in added)))
    return problem, Point(np.concatenate(z), base.point.start)


def race(base: Fit, points: Sequence[tuple[Problem, Point]]) -> list[Fit]:
    """Fits of several hypotheses; after a sketch of each only those that are still in the race go on.

    Positive parameters that end where the effect is absent drop their hypothesis.
    """
    if not points:
        return []
    first = len(base.problem.effects)
    fits = [f for f in sketch(points, tolerance=_tolerance(base)) if f is not None]
    if not fits:
        return []
    share = effective_share(min(fits, key=lambda f: f.chi2))
    top = max(log_evidence(f, share) for f in fits)
    racing = [f for f in fits if log_evidence(f, share) > top - RACE]
    on = [(f.problem, f.point) for f in racing]
    further = fit_many(on, max_iterations=5, tolerance=SETTLED / share) if racing else []
    better = {id(f): g for f, g in zip(racing, further, strict=True) if g is not None}
    return [f for f in (better.get(id(f), f) for f in fits) if _allowed(f, first)]


def gain(base: Fit, fit: Fit, share: float) -> float:
    """Evidence that an addition earns, nats."""
    return log_evidence(fit, share) - log_evidence(base, share)


def _tolerance(fit: Fit) -> float:
    """Gain at which iterations end; under model error a nat of correlated samples is worth less."""
    return SETTLED / effective_share(fit)


def _allowed(fit: Fit, first: int) -> bool:
    """Whether no parameter of the effects from `first` on ended at the wall that keeps it positive."""
    begin = fit.problem.num_psi + sum(e.size for e in fit.problem.effects[:first])
    return bool((fit.point.z > fit.problem.floor + AT_WALL)[begin:].all())


def explain(before: Fit, pool: Sequence[PlacedEffect], progress: Progress = lambda *_: None) -> Explanation:
    """Effects are added while the best still earns its evidence, then each is judged with the others in place."""
    needed, current, first = threshold(len(pool)), before, None
    for _ in range(MAX_EFFECTS):
        slot = look(current, pool, progress)
        first = slot if first is None else first
        best = slot.ranked[0] if slot.ranked else None
        both = _together(current, slot, needed) if len(current.problem.effects) + 2 <= MAX_EFFECTS else None
        if both is None and (best is None or best.gain < needed):
            break
        current = extend(both or best.fit)  # type: ignore[union-attr]
    assert first is not None
    if len(current.problem.effects) == 0:
        return Explanation(before, before, (first,), len(pool), 1.0)
    current, lean = _prune(current, needed)
    same = current.problem.segments.count == before.problem.segments.count
    ranked = {r.placed for r in first.ranked}  # a later effect, left alone once the first was dropped, may not be there
    if len(current.problem.effects) == 1 and same and current.problem.effects[0] in ranked:
        return Explanation(before, current, (first,), len(pool), effective_share(current))
    before = before if same else _refit(current, ())
    slots = tuple(_judge(current, i, lean.get(e), pool, progress) for i, e in enumerate(current.problem.effects))
    return Explanation(before, current, slots, len(pool), effective_share(current))


def _together(base: Fit, slot: Slot, needed: float) -> Fit | None:
    """A fit with two additions, if it earns more than the best single one and a second of its own."""
    alone = slot.ranked[0] if slot.ranked else None
    screened = slot.screened[0].log_evidence if slot.screened else 0.0
    found = refine_pairs(base, slot.screened, max(screened, 0.0) + needed)
    if found is None:
        return None
    share = effective_share(found)
    if alone is None:
        return found if gain(base, found, share) > needed else None
    # Wide posteriors of unknowns that trade with each other are no reason: the recordings must be told better.
    told = share * (log_told(found) - log_told(alone.fit))
    return found if min(told, gain(base, found, share) - gain(base, alone.fit, share)) > needed else None


def _judge(final: Fit, i: int, base: Fit | None, pool: Sequence[PlacedEffect], progress: Progress) -> Slot:
    """What could stand in place i of the list, the other effects staying; the present one competes too."""
    slot = look(base or without(final, i), pool, progress)
    base = slot.base
    own = Ranked(final.problem.effects[i], _reordered(final, i), 0.0)
    own = replace(own, gain=gain(base, own.fit, effective_share(final)))
    rest = [r for r in slot.ranked if r.placed != own.placed]
    return replace(slot, ranked=tuple(sorted([own, *rest], key=lambda r: -r.gain)))


def _keep(fit: Fit, effects: Sequence[PlacedEffect]) -> Point:
    """A fit's unknowns without those of dropped effects."""
    blocks, begin = {}, fit.problem.num_psi
    for e in fit.problem.effects:
        blocks[e] = fit.point.z[begin : begin + e.size]
        begin += e.size
    parts = [fit.point.z[: fit.problem.num_psi], *(blocks[e] for e in effects)]
    return Point(np.concatenate(parts), fit.point.start)


def _refit(fit: Fit, effects: Sequence[PlacedEffect]) -> Fit:
    """The best fit with only some of the effects, on the same segments."""
    found = fit_many([(fit.problem.with_effects(effects), _keep(fit, effects))], tolerance=_tolerance(fit))[0]
    return fit if found is None else found


def without(fit: Fit, i: int) -> Fit:
    """The best fit without effect i."""
    return _refit(fit, [e for k, e in enumerate(fit.problem.effects) if k != i])


def swap(fit: Fit, i: int, other: Ranked) -> Fit:
    """The best fit with another candidate in place i of the list."""
    effects = list(fit.problem.effects)
    if effects[i] == other.placed:
        return fit
    if len(effects) == 1:
        return other.fit
    kept = _keep(fit, [e for k, e in enumerate(effects) if k != i])
    cut_at = fit.problem.num_psi + sum(e.size for e in effects[:i])
    own = other.fit.point.z[other.fit.problem.size - other.placed.size :]
    effects[i] = other.placed
    z = np.concatenate([kept.z[:cut_at], own, kept.z[cut_at:]])
    found = fit_many([(fit.problem.with_effects(effects), Point(z, fit.point.start))], tolerance=_tolerance(fit))[0]
    return fit if found is None else found


def _reordered(fit: Fit, i: int) -> Fit:
    """The same fit with effect i last, as refinement leaves it."""
    effects = list(fit.problem.effects)
    begins = np.cumsum([fit.problem.num_psi, *(e.size for e in effects)])
    own = np.arange(begins[i], begins[i + 1])
    order = np.concatenate([np.setdiff1d(np.arange(fit.problem.size), own), own])
    problem = fit.problem.with_effects([e for k, e in enumerate(effects) if k != i] + [effects[i]])
    lin = fit.linear
    point = Point(lin.point.z[order], lin.point.start)
    moved = replace(lin, problem=problem, point=point, columns=lin.columns[..., order])
    return summarize(moved, True, fit.converged)


def _prune(fit: Fit, needed: float) -> tuple[Fit, dict[PlacedEffect, Fit]]:
    """Drops effects that no longer earn their place beside the later ones; fits without each of those that stay."""
    lean: dict[PlacedEffect, Fit] = {}
    for placed in fit.problem.effects[:-1]:
        rest = without(fit, fit.problem.effects.index(placed))
        if gain(rest, fit, effective_share(fit)) < needed:
            fit, lean = rest, {}
        else:
            lean[placed] = rest
    return fit, lean
