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
LEAST, MOST = 0.3, 12.0  # RMS in noise sds, beside psi and beginnings, of stretches that an effect must have
WORST = 30.0  # noise sds at which a difference is cut off: contact that is made at another time
FACTORS = (0.65, 0.8, 0.9, 1.1, 1.25, 1.5)  # of each psi: whether it hides a large effect
SHIFT = 1e-4, 1e-3  # m or rad, and a second: by which a beginning is moved
SIZES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)  # of the largest


@dataclass(frozen=True)
class _Stretch:
    """One stretch: where and when it begins, its inputs, and what is recorded without an effect."""

    begin: np.ndarray
    times: np.ndarray
    inputs: np.ndarray

    def recorded(self, probe: Probe, psi: dict[str, float], effects: Sequence[Effect] = ()) -> np.ndarray:
        return simulate_reality(probe.system, psi, effects, self.begin, self.times, self.inputs, 1).columns

    def beginnings(self, probe: Probe, plain: np.ndarray) -> np.ndarray:
        """An orthonormal basis of what other beginnings do."""
        model = probe.system.compile(probe.psi)
        steps = np.diag(np.repeat(SHIFT, model.nv))
        others = [replace(self, begin=shifted(model, self.begin, step)).recorded(probe, probe.psi) for step in steps]
        columns = np.stack([_whitened(probe, other, plain) for other in others], 1)
        basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        return basis[:, sizes > 1e-6 * sizes[0]]


def find_short(rng: np.random.Generator, probe: Probe, pair: tuple[str, str]) -> Found | None:
    """An effect that psi and beginnings do not hide in short stretches; None where even the largest is too small."""
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
    changes, columns, afar = [], [], []
    for stretch in _stretches(probe, effect):
        plain = stretch.recorded(probe, probe.psi)
        change = _whitened(probe, stretch.recorded(probe, probe.psi, (effect,)), plain)
        if not np.isfinite(change).all():
            return np.nan, np.nan
        basis = stretch.beginnings(probe, plain)

        def left(change: np.ndarray, basis: np.ndarray = basis) -> np.ndarray:
            return change - basis @ (basis.T @ change)

        changes.append((change, left(change)))
        near = [_whitened(probe, stretch.recorded(probe, psi), plain) for psi in _moved(probe, 1.02)]
        columns.append(np.stack([left(c) for c in near], 1))
        far = [_whitened(probe, stretch.recorded(probe, psi), plain) for f in FACTORS for psi in _moved(probe, f)]
        afar.append(np.stack([left(change - c) for c in far], 1))
    whole, kept = (np.concatenate(part) for part in zip(*changes, strict=True))
    basis, moved = np.concatenate(columns), np.concatenate(afar)
    return min(_beside(basis, one) for one in (kept, *moved.T)), float(np.sqrt(np.mean(whole**2)))


def _beside(basis: np.ndarray, change: np.ndarray) -> float:
    """RMS of a change beside what small changes of psi take up."""
    return float(np.sqrt(np.mean((change - basis @ np.linalg.lstsq(basis, change, rcond=1e-8)[0]) ** 2)))


def _moved(probe: Probe, factor: float) -> list[dict[str, float]]:
    return [probe.psi | {p.name: factor * probe.psi[p.name]} for p in probe.system.psi]


def _whitened(probe: Probe, columns: np.ndarray, plain: np.ndarray) -> np.ndarray:
    return np.clip((columns - plain) / probe.system.noise(), -WORST, WORST).ravel()


def _stretches(probe: Probe, effect: Effect) -> Iterator[_Stretch]:
    """Stretches that start in states of a reality with the effect: a drag slows what it acts on, and is seldom seen."""
    times = probe.times
    lead = int(np.ceil(PREROLL / (times[1] - times[0]) - 1e-9))
    for start, inputs in zip(probe.starts, probe.inputs, strict=True):
        whole = simulate_reality(probe.system, probe.psi, (effect,), start, times, inputs, 1)
        for k in range(0, times.size - STRETCH - lead, APART):
            at = slice(k + lead, k + lead + STRETCH)
            yield _Stretch(whole.states[k], times[at] - times[at][0] + PREROLL, inputs[at])
