"""From candidates beside a fit to the few that are refined: screen, race, and lead on who went astray."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR, by_chance, effective_share, log_evidence
from det2stoc_bayes.mismatch.horizon import climb
from det2stoc_bayes.mismatch.pairs import pairs, varied
from det2stoc_bayes.mismatch.put_back import put_back
from det2stoc_bayes.mismatch.race import (
    Ranked,
    Slot,
    added,
    allowed,
    gain,
    race,
    settled,
    standing,
    threshold,
    tolerance,
)
from det2stoc_bayes.mismatch.screen import Screened, screen
from det2stoc_bayes.mismatch.shortlist import shortlist
from det2stoc_bayes.optimize import Fit, fit_many

NUM_REFINED = 5
NUM_PAIRS = 6
PROMISING = 0.3  # of the best screened evidence: what earns less is not refined
KEPT = 0.5  # of the screened evidence: a fit that earns less may be at a false optimum
NUM_LED = 3  # that promise most, of which the first is looked at for that, and others where they end below the base
Progress = Callable[[str, int, int], None]  # stage, done, total


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
    there = standing(base, present)
    for i, s in enumerate([s for s in worth if s.placed in fits and s in new][:NUM_LED]):
        others, share = [*fits.values(), *there], _share(fits.values())
        leader = max(others, key=lambda f: gain(base, f, share))
        astray = i == 0 or gain(base, fits[s.placed], share) < 0
        if astray and s.log_evidence > gain(base, leader, share) and not any(by_chance(f) for f in others):
            led = _led_on(base, fits[s.placed], s, share)
            fits[s.placed] = _from_leader(base, leader, led, share)
    share = _share(fits.values())
    ranked = [Ranked(placed, f, gain(base, f, share)) for placed, f in fits.items()]
    return Slot(base, tuple(screened), tuple(sorted(ranked, key=lambda r: -r.gain)))


def _share(fits: Iterable[Fit]) -> float:
    """Independent samples per sample, by what the best fit leaves."""
    best = min(fits, key=lambda f: f.chi2, default=None)
    return 1.0 if best is None else effective_share(best)


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


def _from_leader(base: Fit, leader: Fit, fit: Fit, share: float) -> Fit:
    """A fit of what promised more than any earns, from where the leader ended, if that tells more.

    Far from the recordings its trials were judged by what they promise; there, by what the leader leaves.
    """
    placed = fit.problem.effects[-1]
    if leader.problem.effects[-1] == placed or gain(base, leader, share) <= max(gain(base, fit, share), 0.0):
        return fit
    bare = put_back(leader)
    tried = [t for s in screen(bare, [placed], where=leader) for t in (s, *s.others) if t.coefficients.any()]
    found = race(base, [added(bare, t.change, [(t, t.coefficients)]) for t in tried], present=leader)
    return max([fit, *found], key=lambda f: log_evidence(f, share))


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
