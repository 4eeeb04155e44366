"""Sizes of effects where bodies touch: by short stretches, since longer ones are chaotic.

Where a stretch begins is not known better than it is measured: what other beginnings absorb of an effect, stretch by
stretch, does not show in recordings, nor does what another psi absorbs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from det2stoc_bayes.blind.laws import LAWS, Effect
from det2stoc_bayes.blind.probe import Probe
from det2stoc_bayes.blind.reality import PREROLL, shifted, simulate_reality
from det2stoc_bayes.blind.sizing import Found

STRETCH, APART = 20, 20  # samples, and from one stretch to the next
LEAST, MOST = 0.15, 12.0  # RMS in noise sds, beside psi and beginnings, of stretches that an effect must have
WORST = 30.0  # noise sds at which a difference is cut off: contact that is made at another time
NEAR = 1.02  # of each psi: what small changes of it do
FACTORS = (0.65, 0.8, 0.9, 1.1, 1.25, 1.5)  # of each psi: whether it hides a large effect
SHIFT = 1e-4, 1e-3  # m or rad, and a second: by which a beginning is moved
SIZES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)  # of the largest


@dataclass(frozen=True)
class _Stretch:
    """One stretch of a probe's reality: the state in which it begins, when it is recorded, and its inputs."""

    probe: Probe
    begin: np.ndarray
    times: np.ndarray
    inputs: np.ndarray

    def changes(self, effect: Effect) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """What an effect changes, in noise sds; beside other beginnings that, what each psi changes, and what is left.

        The last beside psi that are far off, one a column. None where a simulation diverges.
        """
        probe, plain = self.probe, self._recorded(self.probe.psi)

        def whitened(columns: np.ndarray) -> np.ndarray:
            return np.clip((columns - plain) / probe.system.noise(), -WORST, WORST).ravel()

        change = whitened(self._recorded(probe.psi, (effect,)))
        begins = np.stack([whitened(columns) for columns in self._begun_elsewhere()], 1)
        near = np.stack([whitened(self._recorded(psi)) for psi in _moved(probe, NEAR)], 1)
        far = np.stack([whitened(self._recorded(psi)) for factor in FACTORS for psi in _moved(probe, factor)], 1)
        if not all(np.isfinite(part).all() for part in (change, begins, near, far)):
            return None
        basis, sizes, _ = np.linalg.svd(begins, full_matrices=False)
        basis = basis[:, sizes > 1e-6 * sizes[0]]
        kept, near, left = (x - basis @ (basis.T @ x) for x in (change, near, change[:, None] - far))
        return change, kept, near, left

    def _recorded(self, psi: dict[str, float], effects: Sequence[Effect] = ()) -> np.ndarray:
        return simulate_reality(self.probe.system, psi, effects, self.begin, self.times, self.inputs, 1).columns

    def _begun_elsewhere(self) -> Iterator[np.ndarray]:
        model = self.probe.scene.model
        for step in np.diag(np.repeat(SHIFT, model.nv)):
            yield replace(self, begin=shifted(model, self.begin, step))._recorded(self.probe.psi)


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
    parts = []
    for stretch in _stretches(probe, effect):
        found = stretch.changes(effect)
        if found is None:
            return np.nan, np.nan
        parts.append(found)
    change, kept, near, left = (np.concatenate(part) for part in zip(*parts, strict=True))
    return min(_beside(near, one) for one in (kept, *left.T)), float(np.sqrt(np.mean(change**2)))


def _beside(basis: np.ndarray, change: np.ndarray) -> float:
    """RMS of a change beside what small changes of psi take up."""
    return float(np.sqrt(np.mean((change - basis @ np.linalg.lstsq(basis, change, rcond=1e-8)[0]) ** 2)))


def _moved(probe: Probe, factor: float) -> list[dict[str, float]]:
    return [probe.psi | {p.name: factor * probe.psi[p.name]} for p in probe.system.psi]


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
