"""From candidates beside a fit to the few that are refined: screen, sketch, and fit those that stay in the race."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.linearization import Point, start_point
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, by_chance, effective_share, log_evidence
from det2stoc_bayes.mismatch.horizon import climb
from det2stoc_bayes.mismatch.pairs import pairs, varied
from det2stoc_bayes.mismatch.screen import Screened, screen
from det2stoc_bayes.mismatch.shortlist import shortlist
from det2stoc_bayes.optimize import Fit, fit_many, sketch
from det2stoc_bayes.problem import Problem

NUM_REFINED = 5
NUM_PAIRS = 6
PROMISING = 0.3  # of the best screened evidence: what earns less is not refined
RACE = (10.0, 0.3, 50.0)  # how far behind the best sketch a candidate may be: nats, share of the gain, at most
NUM_LEADERS, MOST_ITERATIONS = 2, 15  # that go on to their optimum while a misfit remains
LEAST_GAIN = 7.0  # nats beyond the log number of candidates: below it an addition is chance
FURTHER, SOON = 5, 2  # iterations of those in the race, and of who went astray beside an explanation far ahead
KEPT = 0.5  # of the screened evidence: a fit that earns less may be at a false optimum
NUM_LED = 3  # that promise most, of which the first is looked at for that, and others where they end below the base
AT_WALL = 1e-6  # prior sds from where a positive parameter is absent
SETTLED = 0.3  # nats that a further iteration may gain
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


def threshold(num_candidates: int) -> float:
    """Evidence gain that an addition must reach, nats."""
    return LEAST_GAIN + float(np.log(max(num_candidates, 1)))


def look(base: Fit, pool: Sequence[PlacedEffect], progress: Progress, present: Fit | None = None) -> Slot:
    """Screen every candidate beside a fit and refine those that may earn their place, or that of one `present`."""
    advance = counted(progress, "screening effects", len(pool))
    return _refined(base, screen(base, pool, advance), (), len(pool), progress, present)


def counted(progress: Progress, stage: str, total: int) -> Callable[[int], None]:
    """Tells the progress of one stage by how much more of it is done."""
    done = 0

    def advance(n: int) -> None:
        nonlocal done
        done += n
        progress(stage, done, total)

    return advance


def look_again(slot: Slot, pool: Sequence[PlacedEffect], progress: Progress, present: Fit | None = None) -> Slot:
    """The same look with fewer candidates."""
    screened = [s for s in slot.screened if s.placed in pool]
    return _refined(slot.base, screened, slot.ranked, len(pool), progress, present)


def _refined(
    base: Fit,
    screened: Sequence[Screened],
    known: Sequence[Ranked],
    count: int,
    progress: Progress,
    present: Fit | None,
) -> Slot:
    """Joint Gauss-Newton of psi and each candidate that may earn its place, best evidence first."""
    best = screened[0].log_evidence if screened else 0.0
    least = max(PROMISING * best, threshold(count) / 3)
    worth = shortlist([s for s in screened if s.log_evidence > least], NUM_REFINED)
    fits = {r.placed: r.fit for r in known if r.placed in {s.placed for s in worth}}
    new = [s for s in worth if s.placed not in fits]
    progress("refining the best", 0, len(new))
    found = race(base, [added(base, t.change, [(t, t.coefficients)]) for s in new for t in _starts(s)], present=present)
    progress("refining the best", len(new), len(new))
    fits |= {f.problem.effects[-1]: f for f in found}
    there = _standing(base, present)
    for i, s in enumerate([s for s in worth if s.placed in fits and s in new][:NUM_LED]):
        standing, share = [*fits.values(), *there], _share(fits.values())
        reached = max(gain(base, f, share) for f in standing)
        astray = i == 0 or gain(base, fits[s.placed], share) < 0
        if astray and s.log_evidence > reached and not any(by_chance(f) for f in standing):
            fits[s.placed] = _led_on(base, fits[s.placed], s, share)
    share = _share(fits.values())
    ranked = [Ranked(placed, f, gain(base, f, share)) for placed, f in fits.items()]
    return Slot(base, tuple(screened), tuple(sorted(ranked, key=lambda r: -r.gain)))


def _share(fits: Iterable[Fit]) -> float:
    """Independent samples per sample, by what the best fit leaves."""
    best = min(fits, key=lambda f: f.chi2, default=None)
    return 1.0 if best is None else effective_share(best)


def _standing(base: Fit, present: Fit | None) -> list[Fit]:
    """The fit of what stands in a place, where it is of the same samples."""
    if present is None or present.problem.segments.key != base.problem.segments.key:
        return []
    return [present]


def _led_on(base: Fit, fit: Fit, lead: Screened, share: float) -> Fit:
    """A fit that keeps little of what was promised may be at a false optimum, which short stretches do not have.

    psi, which may have gone astray with it, starts where it was.
    """
    if fit.noise_inflation < MODEL_ERROR or gain(base, fit, share) > KEPT * lead.log_evidence:
        return fit
    z = np.concatenate([base.point.z, fit.point.z[len(base.point.z) :]])
    other, first = climb(fit.problem, z, until=fit.problem.segments), len(base.problem.effects)
    if other is not None and other.problem.segments.key != fit.problem.segments.key:
        point = start_point(fit.problem, other.point.z, fit.linear)
        other = fit_many([(fit.problem, point)], tolerance=tolerance(fit))[0]
    if other is None:
        return fit
    (other,) = settled([other], share, first)
    return other if allowed(other, first) and log_evidence(other, share) > log_evidence(fit, share) else fit


def _starts(s: Screened) -> list[Screened]:
    """An effect's best trial, and the best that has other columns: where parameters multiply, they end apart."""
    return [s, *[t for t in s.others if len(t.trial.columns) != len(s.trial.columns)][:1]]


def refine_pairs(
    base: Fit,
    screened: Sequence[Screened],
    least: float,
    known: dict[frozenset[PlacedEffect], Fit | None],
    most: int,
) -> list[Fit]:
    """Fits with two additions at once whose screening promises more than `least` nats, best evidence first.

    `known` are pairs that ran beside this fit before, None where they lost; those that run now join them.
    """
    worth = varied([p for p in pairs(base, screened) if p.log_evidence > least], most)
    new = [p for p in worth if p.key not in known]
    points = [added(base, p.change, list(zip(p.members, p.coefficients, strict=True))) for p in new]
    found = {frozenset(f.problem.effects[-2:]): f for f in race(base, points, most=most // 2)}
    known |= {p.key: found.get(p.key) for p in new}
    fits = [f for f in (known[p.key] for p in worth) if f is not None]
    share = _share(fits)
    return sorted(fits, key=lambda f: -gain(base, f, share))


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
    standing = _standing(base, present)
    known = [f for f in standing if by_chance(f)]
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
    told = explained or any(log_evidence(f, share) > floor + RACE[2] for f in standing)
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


def settled(fits: Sequence[Fit], share: float, first: int) -> list[Fit]:
    """Those on their way at their optima: under a large misfit a race ends long before that, and the slower may win."""
    slow = [f for f in fits if f.end == "unfinished" and f.noise_inflation >= MODEL_ERROR]
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
