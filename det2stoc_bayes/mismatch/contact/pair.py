"""A hypothesis on the windows that are fitted and on those held out: how it is fitted, settled and added to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.mismatch.contact.exchange import exchanged
from det2stoc_bayes.mismatch.contact.scales import certainty
from det2stoc_bayes.mismatch.contact.screen import Promise
from det2stoc_bayes.mismatch.contact.window_fit import WindowFit, at, fit_windows
from det2stoc_bayes.mismatch.contact.window_starts import smoothed
from det2stoc_bayes.mismatch.contact.windows import Windows
from det2stoc_bayes.mismatch.effects import PlacedEffect

ROUNDS = 8  # of fits, each with new sensitivities to starts
SKETCH = 4  # iterations of what was screened
SETTLED = 0.15  # sds of the unknowns
AHEAD = (1.0, 3.0)  # times the last round's way
FINER_CERTAIN = 1.5  # standard errors by which a finer integration must tell windows better


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

    @property
    def heights(self) -> Float[np.ndarray, " windows"]:
        """The same and the measurement's -log density of every start: what hypotheses are compared by."""
        return np.concatenate([self.fit.heights, self.held.heights])

    def gain(self, base: "Pair") -> float:
        """Nats by which all windows are told better than by another hypothesis."""
        return float(base.heights.sum() - self.heights.sum())


def settled(windows: Windows, z: Float[np.ndarray, " size"] | None = None, rounds: int = ROUNDS) -> WindowFit:
    """Unknowns and starts, these from recorded ones anew, until the unknowns hardly move.

    What stands in for one another, as drag for friction, lies along a narrow valley: each round tries to go on as far,
    and much farther, as the last one went.
    """
    z = np.zeros(windows.problem.size) if z is None else z
    fit = fit_windows(smoothed(windows.fine(), z), z)
    last, moves = fit, None
    for _ in range(rounds - 1):
        ways = [fit.z + far * (fit.z - last.z) for far in AHEAD] if moves is not None else []
        ahead = [np.maximum(way, fit.problem.floor) for way in ways]
        last, fit = fit, fit_windows(fit.windows, fit.z, others=ahead, moves=moves)
        moves = fit.away - last.away
        if np.all(np.abs(fit.z - last.z) < SETTLED * np.sqrt(np.diag(fit.covariance))):
            break
    return fit


def converged(fit: WindowFit) -> tuple[WindowFit, bool]:
    """The fit under an integration that converges, where that tells the windows better, and whether it does."""
    problem = fit.problem
    step = float(problem.simulator.model.opt.timestep)
    fine = replace(problem, timestep=step, integrator="RK4", finer=None)
    other = fit_windows(fit.windows.with_problem(fine), fit.z, near=fit.start_columns, iterations=3)
    bare = at(fit.windows.with_problem(replace(other.problem, timestep=None, integrator=None)), other.z)
    reference = min((fit, bare), key=lambda f: f.loss)
    if certainty(reference.heights - other.heights, fit.windows.recording) < FINER_CERTAIN:
        return fit, False
    return settled(other.windows, other.z, 2), True


def held_out(fit: WindowFit, windows: Windows, near: np.ndarray | None = None) -> WindowFit:
    """The hypothesis on held-out windows: shared unknowns as fitted, those of single recordings fitted to each."""
    problem = replace(windows.problem, effects=fit.problem.effects, spreads=fit.problem.spreads)
    z = fit.problem.carry(fit.z, problem)
    owned = set(problem.unknowns.owned.tolist())
    shared = [i for i in range(problem.size) if i not in owned]
    found = fit_windows(windows.with_problem(problem), z, held=shared, near=near, iterations=3)
    return replace(found, scales=fit.scales)


def shifted(pair: Pair, timestep: float, integrator: str) -> Pair:
    """The same unknowns under the believed integration, whose error there is taken off."""
    fit = at(pair.fit.windows.shifted(pair.fit.z, timestep, integrator), pair.fit.z)
    return Pair(fit, at(pair.held.windows.shifted(pair.held.z, timestep, integrator), pair.held.z, fit.scales))


def added(base: Pair, promise: Promise) -> Pair:
    """The hypothesis with a screened addition, fitted."""
    fit = added_fit(base.fit, promise)
    return Pair(fit, held_out(fit, base.held.windows, base.held.start_columns))


def added_fit(base: WindowFit, promise: Promise, iterations: int = SKETCH) -> WindowFit:
    """The same on fitted windows alone."""
    problem = base.problem
    more = problem.with_effects((*problem.effects, promise.placed))
    new = _unknowns(promise)
    ways = [np.concatenate([base.z + a * promise.change, b * new]) for a, b in ((1.0, 1.0), (0.0, 1.0), (0.3, 0.3))]
    first, *others = (np.maximum(z, more.floor) for z in ways)
    windows = base.windows.with_problem(more)
    near = base.start_columns
    return fit_windows(windows, first, others=others, near=near, moves=promise.moves, iterations=iterations)


def _unknowns(promise: Promise) -> np.ndarray:
    z = promise.placed.effect.to_normal(promise.values, promise.placed.typical)
    return np.clip(np.nan_to_num(z), -4.0, 4.0)


def resettled(pair: Pair) -> Pair:
    """With starts estimated under the whole hypothesis, of fitted and held-out windows."""
    finer = pair.fit.problem.finer
    fit = settled(pair.fit.windows, pair.fit.z)
    problem = replace(pair.held.windows.fine().problem, effects=fit.problem.effects, spreads=fit.problem.spreads)
    windows = pair.held.windows.with_problem(problem)
    windows = smoothed(windows, fit.problem.carry(fit.z, problem))
    found = Pair(fit, held_out(fit, windows))
    return found if finer is None else shifted(found, finer.timestep, finer.integrator)


def exchanged_pairs(pairs: Sequence[Pair]) -> list[Pair]:
    """Each from the likeliest of all their starts."""
    fits = exchanged([p.fit for p in pairs])
    held = [replace(p.held, scales=f.scales) for p, f in zip(pairs, fits, strict=True)]
    return [Pair(f, h) for f, h in zip(fits, exchanged(held, own_scales=False), strict=True)]


def without_last(pair: Pair) -> Pair:
    """The same starts and psi without the effect that was added last."""
    effects, size = pair.fit.problem.effects[:-1], pair.placed.size
    fit, held = (one.windows.with_problem(one.problem.with_effects(effects)) for one in (pair.fit, pair.held))
    found = at(fit, pair.fit.z[:-size])
    return Pair(found, at(held, pair.held.z[:-size], found.scales))
