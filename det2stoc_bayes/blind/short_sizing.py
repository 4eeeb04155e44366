"""Sizes of effects where bodies touch: by short stretches from true states, since longer ones are chaotic."""

from collections.abc import Sequence

import numpy as np

from det2stoc_bayes.blind.laws import LAWS, Effect
from det2stoc_bayes.blind.probe import Probe
from det2stoc_bayes.blind.reality import PREROLL, simulate_reality
from det2stoc_bayes.blind.sizing import Found

STRETCH, APART = 15, 20  # samples, and from one stretch to the next
LEAST, MOST = 1.0, 12.0  # RMS in noise sds, beside psi, of stretches that an effect must have
WORST = 30.0  # noise sds at which a difference is cut off: contact that is made at another time
FACTORS = (0.65, 0.8, 0.9, 1.1, 1.25, 1.5)  # of each psi: whether it hides a large effect
SIZES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)  # of the largest


def find_short(rng: np.random.Generator, probe: Probe, pair: tuple[str, str]) -> Found | None:
    """An effect that psi does not hide in short stretches; None where even the largest is too small."""
    name, element = pair
    law = LAWS[name]
    drawn, sign = law.draw(rng, probe.scene, element), float(rng.choice((-1.0, 1.0))) if law.signed else 1.0
    largest = law.largest(probe.scene, element)
    columns = [_change(probe, psi, ()) for psi in _moved(probe, 1.02)]
    afar = [_change(probe, psi, ()) for factor in FACTORS for psi in _moved(probe, factor)]
    for share in rng.permutation(SIZES):
        effect = Effect(name, law.kind, element, law.parameters(sign * share * largest, drawn))
        change = _change(probe, probe.psi, (effect,))
        if not np.isfinite(change).all():
            continue
        basis = np.stack(columns, 1)
        hidden = [change, *(change - far for far in afar)]
        size = min(_left(basis, one) for one in hidden)
        if LEAST <= size <= MOST:
            return Found(effect, size, float(np.sqrt(np.mean(change**2))))
    return None


def _left(basis: np.ndarray, change: np.ndarray) -> float:
    """RMS of a change beside what small changes of psi take up."""
    return float(np.sqrt(np.mean((change - basis @ np.linalg.lstsq(basis, change, rcond=1e-8)[0]) ** 2)))


def _moved(probe: Probe, factor: float) -> list[dict[str, float]]:
    return [probe.psi | {p.name: factor * probe.psi[p.name]} for p in probe.system.psi]


def _change(probe: Probe, psi: dict[str, float], effects: Sequence[Effect]) -> np.ndarray:
    """Differences from the plain model in noise sds over stretches that start in its own states."""
    out, noise, times = [], probe.system.noise(), probe.times
    lead = int(np.ceil(PREROLL / (times[1] - times[0]) - 1e-9))
    for start, inputs in zip(probe.starts, probe.inputs, strict=True):
        whole = simulate_reality(probe.system, probe.psi, (), start, times, inputs, 1)
        for k in range(0, times.size - STRETCH - lead, APART):
            at = slice(k + lead, k + lead + STRETCH)
            moved = times[at] - times[at][0] + PREROLL
            runs = [
                simulate_reality(probe.system, p, e, whole.states[k], moved, inputs[at], 1).columns
                for p, e in ((probe.psi, ()), (psi, effects))
            ]
            out.append(np.clip((runs[1] - runs[0]) / noise, -WORST, WORST).ravel())
    return np.concatenate(out)
