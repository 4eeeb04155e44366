"""psi under effects that no recording tells from the one that is named: a clock that runs fast looks like less mass."""

from collections.abc import Mapping, Sequence

import numpy as np

from det2stoc_bayes.errors import listing
from det2stoc_bayes.mismatch import finding

BEYOND = 2.0  # sds of the difference, as of independent draws, from which a psi is another
WITHIN = 1.96  # sds that hold 95 % of a Gaussian
LISTED = 3  # equivalents in a sentence


def others_beyond(
    given: Mapping[str, finding.Moments], named: Mapping[str, finding.Moments]
) -> dict[str, finding.Moments]:
    """The psi that differ from those under the named effect by more than BEYOND."""
    out = {}
    for name, mine in given.items():
        (a, sd_a), (b, sd_b) = (np.array([m.mean, m.sd], float) for m in (mine, named[name]))
        if abs(a - b) > BEYOND * np.hypot(sd_a, sd_b):
            out[name] = mine
    return out


def over_equivalents(
    psi: Mapping[str, finding.PsiChange],
    effects: Sequence[finding.Effect],
    supports: Mapping[str, tuple[float, float]],
) -> dict[str, finding.PsiChange]:
    """With the interval, within the prior's support, that holds those of every equivalent that means another value."""
    out = dict(psi)
    for name, change in psi.items():
        others = [o.psi[name] for e in effects for o in e.equivalent if name in o.psi]
        if others:
            means, sds = np.array([(m.mean, m.sd) for m in (change.after, *others)], float).T
            ends = np.clip([(means - WITHIN * sds).min(), (means + WITHIN * sds).max()], *supports[name])
            out[name] = change.model_copy(update={"over_equivalents": (float(ends[0]), float(ends[1]))})
    return out


def other_psi(effect: finding.Effect) -> str:
    """Which equivalents would mean other psi; empty where none would."""
    said = []
    for other in effect.equivalent:
        if other.psi:
            values = listing([f"{name} {m.mean:.4g}" for name, m in other.psi.items()])
            said.append(f"{other.name.replace('_', ' ')} on {other.element.name} means {values}")
    more = len(said) - LISTED
    rest = [f"{more} more mean others"] if more > 0 else []
    return f"psi hangs on which it is: {'; '.join([*said[:LISTED], *rest])}." if said else ""
