"""Sizes of effects where bodies touch: by short stretches, since longer ones are chaotic.

Where a stretch begins is not known better than it is measured: what other beginnings absorb of an effect, stretch by
stretch, does not show in recordings, nor does what another psi absorbs, which may be far off: evolution finds it where
steps by derivatives, few samples being off by much, come to nothing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from cmaes import CMA

from det2stoc_bayes.blind.laws import LAWS, Effect
from det2stoc_bayes.blind.probe import Probe
from det2stoc_bayes.blind.reality import PREROLL, shifted, simulate_reality
from det2stoc_bayes.blind.sizing import Found

STRETCH, APART = 20, 20  # samples, and from one stretch to the next
LEAST, MOST = 0.25, 12.0  # RMS in noise sds, beside psi and beginnings, of stretches that an effect must have
WORST = 30.0  # noise sds at which a difference is cut off: contact that is made at another time
NEAR = 1.02  # of each psi: what small changes of it do
POPULATION, SEED = 16, 3
SEARCHES = ((0.15, 10), (0.02, 6))  # log factors of psi in which these begin, and generations: ever nearer
SHIFT = 1e-4, 1e-3  # m or rad, and a second: by which a beginning is moved
SIZES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)  # of the largest


@dataclass(frozen=True)
class _Stretch:
    """One stretch of a probe's reality: the state in which it begins, when it is recorded, and its inputs."""

    probe: Probe
    begin: np.ndarray
    times: np.ndarray
    inputs: np.ndarray

    def recorded(self, psi: dict[str, float], effects: Sequence[Effect] = ()) -> np.ndarray:
        """Without noise; NaN where the simulation diverges."""
        return simulate_reality(self.probe.system, psi, effects, self.begin, self.times, self.inputs, 1).columns

    def begun_elsewhere(self) -> Iterator[np.ndarray]:
        """The same, each coordinate of the beginning moved."""
        model = self.probe.scene.model
        for step in np.diag(np.repeat(SHIFT, model.nv)):
            yield replace(self, begin=shifted(model, self.begin, step)).recorded(self.probe.psi)


class _Change:
    """What an effect changes in a stretch, in noise sds, and what other beginnings take up."""

    def __init__(self, stretch: _Stretch, effect: Effect) -> None:
        self.stretch, plain = stretch, stretch.recorded(stretch.probe.psi)
        self.changed = stretch.recorded(stretch.probe.psi, (effect,))
        self.whole = self._whitened(self.changed - plain)
        begins = np.stack([self._whitened(columns - plain) for columns in stretch.begun_elsewhere()], 1)
        if np.isfinite(begins).all():
            basis, sizes, _ = np.linalg.svd(begins, full_matrices=False)
            self.basis = basis[:, sizes > 1e-6 * sizes[0]]
        else:
            self.basis = begins  # what is left is NaN, too

    def left(self, psi: dict[str, float]) -> np.ndarray:
        """What the effect changes beyond what psi would, beside beginnings."""
        change = self._whitened(self.changed - self.stretch.recorded(psi))
        return change - self.basis @ (self.basis.T @ change)

    def _whitened(self, columns: np.ndarray) -> np.ndarray:
        return np.clip(columns / self.stretch.probe.system.noise(), -WORST, WORST).ravel()


def find_short(rng: np.random.Generator, probe: Probe, pair: tuple[str, str]) -> Found | None:
    """An effect that psi and beginnings do not hide in short stretches; None where even the largest is too small.

    ValueError: recordings too short for a stretch.
    """
    name, element = pair
    law = LAWS[name]
    drawn, sign = law.draw(rng, probe.scene, element), float(rng.choice((-1.0, 1.0))) if law.signed else 1.0
    largest = law.largest(probe.scene, element)
    for share in rng.permutation(SIZES):
        effect = Effect(name, law.kind, element, law.parameters(sign * share * largest, drawn))
        size, change = told(probe, effect)
        if LEAST <= size <= MOST:
            return Found(effect, size, change)
    return None


def told(probe: Probe, effect: Effect) -> tuple[float, float]:
    """RMS in noise sds of what an effect does to stretches of its own reality: beside psi and beginnings, and in all.

    NaN where a simulation diverges.
    """
    changes = [_Change(stretch, effect) for stretch in _stretches(probe, effect)]
    whole = float(np.sqrt(np.mean(np.concatenate([c.whole for c in changes]) ** 2)))
    least = _beside_psi(changes, probe.psi, list(_in_its_place(effect, probe.psi)))
    return (least, whole) if np.isfinite(least) else (np.nan, np.nan)


def _in_its_place(effect: Effect, psi: dict[str, float]) -> Iterator[dict[str, float]]:
    """psi that may be what the effect makes of it: one is a parameter's value, so much more or so many times it.

    Impacts tell a contact's time to a few thousandths, nearer than a search comes.
    """
    numbers = {float(np.ravel(value)[0]) for value in effect.parameters.values() if np.ptp(value) == 0}
    for number in (n for n in numbers if n > 0):
        for name, value in psi.items():
            for other in (number, value + number, value * number, value / number):
                yield psi | {name: other}


def _beside_psi(changes: Sequence[_Change], psi: dict[str, float], others: Sequence[dict[str, float]]) -> float:
    """The least RMS that is found, at other psi or on the way to that which hides most; NaN where it diverges here."""

    def left(there: dict[str, float]) -> np.ndarray:
        return np.concatenate([c.left(there) for c in changes])

    def near(there: dict[str, float]) -> float:
        here = left(there)
        moved = np.stack([here - left(there | {name: NEAR * value}) for name, value in there.items()], 1)
        if not (np.isfinite(here).all() and np.isfinite(moved).all()):
            return np.nan
        return float(np.sqrt(np.mean((here - moved @ np.linalg.lstsq(moved, here, rcond=1e-8)[0]) ** 2)))

    def raw_of(there: dict[str, float]) -> float:
        return float(np.nan_to_num(np.mean(left(there) ** 2), nan=WORST**2))

    size = max(len(psi), 2)  # of one dimension CMA-ES knows nothing: another stands idle
    least, raw, best = near(psi), np.inf, psi
    for there in (psi, *others) if least >= LEAST else ():
        if (found := raw_of(there)) < raw:
            raw, best = found, there
        if raw < LEAST**2:
            return float(np.sqrt(raw))
    for sigma, generations in SEARCHES if least >= LEAST else ():
        search = CMA(mean=np.zeros(size), sigma=sigma, seed=SEED, population_size=POPULATION)
        about = best
        for _ in range(generations):
            asked = [search.ask() for _ in range(POPULATION)]
            tried = [{n: float(v * np.exp(f)) for (n, v), f in zip(about.items(), x, strict=False)} for x in asked]
            each = [raw_of(there) for there in tried]
            search.tell(list(zip(asked, each, strict=True)))
            if min(each) < raw:
                raw, best = min(each), tried[int(np.argmin(each))]
            if raw < LEAST**2:
                return float(np.sqrt(raw))
    return float(np.fmin(min(least, np.sqrt(raw)), near(best))) if best is not psi else least


def _stretches(probe: Probe, effect: Effect) -> Iterator[_Stretch]:
    """Stretches that start in states of a reality with the effect: a drag slows what it acts on, and is seldom seen."""
    times = probe.times
    lead = int(np.ceil(PREROLL / (times[1] - times[0]) - 1e-9))
    if times.size < STRETCH + lead:
        found = f"{probe.system.name}: recordings of {times.size} samples"
        raise ValueError(f"{found}; allowed: {STRETCH + lead} or more where bodies touch")
    for start, inputs in zip(probe.starts, probe.inputs, strict=True):
        whole = simulate_reality(probe.system, probe.psi, (effect,), start, times, inputs, 1)
        for k in range(0, times.size - STRETCH - lead + 1, APART):
            at = slice(k + lead, k + lead + STRETCH)
            yield _Stretch(probe, whole.states[k], times[at], inputs[at])
