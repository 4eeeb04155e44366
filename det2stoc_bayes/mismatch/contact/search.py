"""Additions to the believed model, judged by windows that were not fitted: what is named must tell those better."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.mismatch.contact.scales import certainty
from det2stoc_bayes.mismatch.contact.screen import Promise, screen
from det2stoc_bayes.mismatch.contact.window_fit import WindowFit, at, fit_windows
from det2stoc_bayes.mismatch.contact.window_starts import smoothed
from det2stoc_bayes.mismatch.contact.windows import Windows
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.shortlist import shortlist

NUM_REFINED = 5  # the best candidates, which are fitted
NUM_SETTLED = 3  # of them, whose starts are estimated anew
FAR = 2.0  # prior sds
CHANCE = 0.05  # tail probability beyond which a screened effect is not fitted: fitted gains decide
LEAST_GAIN = 3.0  # nats, likewise
LEAST_CERTAIN = 3.0  # standard errors of the gain over windows: of those fitted
HELD_CERTAIN = 2.0  # and of those held out
MAX_EFFECTS = 2
ROUNDS = 6  # of estimating starts and unknowns in turn
MOST_ROUNDS = 20  # of what is taken: its starts were estimated without it, and hold it back
MOST_FORETOLD, FARTHEST_AHEAD = 0.75, 2.0  # share of the last round's way; prior sds
SETTLED = 0.3  # sds of the unknowns
FINER_CERTAIN = 1.5  # standard errors by which a finer integration must tell windows better
LEAST_WINDOWS = 8  # that are held out, or nothing is decided by them
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Pair:
    """A hypothesis on the windows that are fitted and, at the same unknowns, on those held out."""

    fit: WindowFit
    held: WindowFit

    @property
    def placed(self) -> PlacedEffect:
        """The effect that was added last."""
        return self.fit.problem.effects[-1]

    @property
    def owners(self) -> Int[np.ndarray, " windows"]:
        """A number for the recording of every window, in the order of `losses`; held-out recordings are others."""
        first = len(self.fit.problem.segments.recordings)
        return np.concatenate([self.fit.windows.recording, first + self.held.windows.recording])

    @property
    def losses(self) -> Float[np.ndarray, " windows"]:
        """-log likelihood of every window, held-out ones last."""
        return np.concatenate([self.fit.losses, self.held.losses])


@dataclass(frozen=True, eq=False)
class Round:
    """One look for a further effect: what was screened, what was fitted (best first), and what was taken."""

    base: Pair
    screened: tuple[Promise, ...]
    refined: tuple[Pair, ...]
    taken: Pair | None


def settled(windows: Windows, z: Float[np.ndarray, " size"] | None = None, rounds: int = ROUNDS) -> WindowFit:
    """Starts and unknowns in turn, until these hardly move.

    Starts that were estimated under other unknowns hold these back, so that each round goes a share of the way that
    the last one went: the rest of the way is foretold from it (Aitken).
    """
    z = np.zeros(windows.problem.size) if z is None else z
    last = np.zeros(len(z))
    for k in range(rounds):
        windows = smoothed(windows.fine(), z)
        fit = fit_windows(windows, z, iterations=6 if k == 0 else 3)
        step = fit.z - z
        if k + 1 == rounds or np.all(np.abs(step) < SETTLED * np.sqrt(np.diag(fit.covariance))):
            return fit
        share = np.clip(np.divide(step, last, out=np.zeros(len(z)), where=np.abs(last) > 1e-9), 0.0, MOST_FORETOLD)
        ahead = np.clip(step * share / (1 - share), -FARTHEST_AHEAD, FARTHEST_AHEAD)
        z, last = np.maximum(fit.z + ahead, fit.problem.floor), step
    raise ValueError("rounds: found 0; allowed: 1 or more")


def converged(fit: WindowFit) -> tuple[WindowFit, bool]:
    """The fit under an integration that converges, where that tells the windows better, and whether it does."""
    problem = fit.problem
    step = float(problem.simulator.model.opt.timestep)
    fine = replace(problem, timestep=step, integrator="RK4", finer=None)
    other = settled(fit.windows.with_problem(fine), fit.z, 2)
    bare = at(fit.windows.with_problem(replace(other.problem, timestep=None, integrator=None)), other.z)
    reference = min((fit, bare), key=lambda f: f.loss)
    if certainty(reference.losses - other.losses, fit.windows.recording) < FINER_CERTAIN:
        return fit, False
    return other, True


def held_out(fit: WindowFit, windows: Windows, own: bool = True) -> WindowFit:
    """The hypothesis on held-out windows: shared unknowns as fitted, those of single recordings fitted to each."""
    problem = replace(windows.problem, effects=fit.problem.effects, spreads=fit.problem.spreads)
    here = windows.with_problem(problem)
    z = fit.problem.carry(fit.z, problem)
    owned = set(problem.unknowns.owned.tolist())
    if owned and own:
        shared = [i for i in range(problem.size) if i not in owned]
        z = fit_windows(here, z, held=shared, iterations=3).z
    return at(here, z, fit.scales)


def look(base: Pair, pool: Sequence[PlacedEffect], progress: Progress) -> Round:
    """Screen all, fit the few best, and take the best that windows which were not fitted ask for.

    What is missing may have led psi far from its prior, where small steps do not lead back: then the middle of the
    prior is a second ground to start from.
    """
    other = recentred(base)
    grounds = [base] if other is None else [base, other]
    others, done = [p for p in pool if p not in base.fit.problem.effects], [0]

    def advance(n: int) -> None:
        done[0] += n
        progress("screening effects", done[0], len(others) * len(grounds))

    screened = [screen(g.fit, others, advance) for g in grounds]
    worth = [
        shortlist([s for s in found if s.tail < CHANCE and s.gain > LEAST_GAIN], NUM_REFINED // len(grounds))
        for found in screened
    ]
    count, found = sum(len(w) for w in worth), []
    for ground, promises in zip(grounds, worth, strict=True):
        here = []
        for promise in promises:
            progress("refining the best", len(found) + len(here), count)
            here.append(added(ground, promise))
        here.sort(key=lambda p: p.losses.sum())
        found += [resettled(p) for p in here[:NUM_SETTLED]] + here[NUM_SETTLED:]
    if count:
        progress("refining the best", count, count)
    refined = distinct(sorted(found, key=lambda p: p.losses.sum()))
    taken = next((p for p in refined[:3] if earns(base, p)), None)
    return Round(base, tuple(screened[0]), tuple(refined), taken)


def recentred(base: Pair) -> Pair | None:
    """The hypothesis with psi in the middle of its prior, if the fit has led it FAR from there."""
    problem = base.fit.problem
    psi = np.arange(problem.size) < problem.num_psi
    if np.abs(base.fit.z[psi]).max(initial=0.0) < FAR:
        return None
    z = np.where(psi, 0.0, base.fit.z)
    fit, held = (smoothed(one.windows.fine(), problem.carry(z, one.problem)) for one in (base.fit, base.held))
    there = at(fit, z)
    other = Pair(there, at(held, problem.carry(z, base.held.problem), there.scales))
    finer = problem.finer
    return other if finer is None else shifted(other, finer.timestep, finer.integrator)


def distinct(pairs: Sequence[Pair]) -> list[Pair]:
    """The first of each addition."""
    first: dict[PlacedEffect, Pair] = {}
    for pair in pairs:
        first.setdefault(pair.placed, pair)
    return list(first.values())


def shifted(pair: Pair, timestep: float, integrator: str) -> Pair:
    """The same unknowns under the believed integration, whose error there is taken off."""
    fit = at(pair.fit.windows.shifted(pair.fit.z, timestep, integrator), pair.fit.z)
    return Pair(fit, at(pair.held.windows.shifted(pair.held.z, timestep, integrator), pair.held.z, fit.scales))


def added(base: Pair, promise: Promise) -> Pair:
    """The hypothesis with a screened addition, fitted."""
    problem = base.fit.problem
    more = problem.with_effects((*problem.effects, promise.placed))
    z = np.concatenate([base.fit.z + promise.change, _unknowns(promise)])
    plain = np.concatenate([base.fit.z, z[problem.size :]])
    half = np.concatenate([base.fit.z + 0.3 * promise.change, 0.3 * z[problem.size :]])
    z, plain, half = (np.maximum(x, more.floor) for x in (z, plain, half))
    fit = fit_windows(base.fit.windows.with_problem(more), z, others=[plain, half], iterations=6)
    return Pair(fit, held_out(fit, base.held.windows))


def _unknowns(promise: Promise) -> np.ndarray:
    z = promise.placed.effect.to_normal(promise.values, promise.placed.typical)
    return np.clip(np.nan_to_num(z), -4.0, 4.0)


def earns(base: Pair, more: Pair) -> bool:
    """Whether an addition tells fitted and held-out windows better than chance does."""
    fitted = certainty(base.fit.losses - more.fit.losses, more.fit.windows.recording)
    if fitted < LEAST_CERTAIN or not (more.fit.z > more.fit.problem.floor + 1e-6).all():
        return False
    if more.held.windows.count < LEAST_WINDOWS:
        return fitted > LEAST_CERTAIN + HELD_CERTAIN
    return certainty(base.held.losses - more.held.losses, more.held.windows.recording) > HELD_CERTAIN


def resettled(pair: Pair, rounds: int = 2) -> Pair:
    """With starts estimated under the whole hypothesis, of fitted and held-out windows."""
    finer = pair.fit.problem.finer
    fit = settled(pair.fit.windows, pair.fit.z, rounds)
    problem = replace(pair.held.windows.fine().problem, effects=fit.problem.effects, spreads=fit.problem.spreads)
    windows = pair.held.windows.with_problem(problem)
    windows = smoothed(windows, fit.problem.carry(fit.z, problem))
    found = Pair(fit, held_out(fit, windows))
    return found if finer is None else shifted(found, finer.timestep, finer.integrator)


def chances(pairs: Sequence[Pair], random: np.random.Generator, count: int = 4000) -> Float[np.ndarray, " pairs"]:
    """Chance of each hypothesis to tell recordings like these best, by the Bayesian bootstrap over recordings."""
    _, groups = np.unique(pairs[0].owners, return_inverse=True)
    losses = np.stack([np.bincount(groups, p.losses) for p in pairs], 1)
    losses = losses + np.array([0.5 * p.placed.size for p in pairs]) / len(losses)
    weights = random.dirichlet(np.ones(len(losses)), count) * len(losses)
    best = (weights @ losses).argmin(1)
    return np.bincount(best, minlength=len(pairs)) / count


def alike(a: Pair, b: Pair) -> Bool[np.ndarray, ""]:
    """Whether two hypotheses predict the same, within a small part of what they leave."""
    apart = (a.fit.errors - b.fit.errors) / a.fit.scales.values
    near = np.nanmean(np.minimum(apart**2, 9.0)) < 0.05
    total = a.losses - b.losses
    return np.asarray(near and abs(certainty(total, a.owners)) < 2.0)
