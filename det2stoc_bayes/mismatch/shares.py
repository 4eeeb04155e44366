"""What part of the held-out error an effect explains, over all recordings and in each of them."""

from typing import Any

import numpy as np

from det2stoc_bayes.mismatch.evidence import CHANCE
from det2stoc_bayes.mismatch.finding import Effect, RecordingPart
from det2stoc_bayes.mismatch.heldout import HeldOut

NEGLIGIBLE = 0.05  # of the held-out squared error beyond noise
CHANGED = 4 * CHANCE**2  # two predictions a squared distance d apart differ in chi2 by d +- 2 sqrt(d) under noise


def share_explained(believed: HeldOut, base: HeldOut, better: HeldOut) -> float:
    """Share of the believed model's held-out squared excess that goes when `base` becomes `better`."""
    excess = excess_beyond_chance(believed)
    return float(np.clip((base.chi2.sum() - better.chi2.sum()) / excess, -1.0, 1.0)) if excess else 0.0


def excess_beyond_chance(scores: HeldOut) -> float:
    """Squared whitened error in excess of noise, 0 while noise alone may well have made it."""
    return _excess(scores.chi2.sum(), scores.num_values.sum())


def shares_by_recording(believed: HeldOut, base: HeldOut, better: HeldOut) -> tuple[RecordingPart, ...]:
    """The same in each recording; null where its error is no more than chance.

    uncertain: more of the recording's error stays unexplained than goes; negligible: what goes is chance, or next to
    nothing of the error.
    """
    out = []
    for i, name in enumerate(believed.names):
        values = float(believed.num_values[i])
        before, left = _excess(believed.chi2[i], values), _excess(better.chi2[i], values)
        gain = float(base.chi2[i] - better.chi2[i])
        small = abs(gain) < (NEGLIGIBLE * before if before else CHANGED)
        kind = "negligible" if small else "uncertain" if gain < left else "explained"
        share = float(np.clip(gain / before, -1.0, 1.0)) if before else None
        out.append(RecordingPart(recording=name, explains=share, kind=kind))
    return tuple(out)


def by_element(effects: tuple[Effect, ...]) -> list[dict[str, Any]]:
    """Each element's share of what the effects explain together."""
    total = sum(max(e.explains or 0.0, 0.0) for e in effects) or 1.0
    shares: dict[tuple[str, str], float] = {}
    for e in effects:
        key = (e.element.kind, e.element.name)
        shares[key] = shares.get(key, 0.0) + max(e.explains or 0.0, 0.0) / total
    return [{"kind": kind, "name": name, "share": s} for (kind, name), s in shares.items()]


def _excess(chi2: float, values: float) -> float:
    excess = float(chi2 - values)
    return excess if excess > CHANCE * np.sqrt(2 * values) else 0.0
