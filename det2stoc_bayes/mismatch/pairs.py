"""Two additions at once: where each of two effects is hidden by the lack of the other, neither is found alone."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.addition import add
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.screen import Screened, one_sided
from det2stoc_bayes.optimize import Fit

MOST_OFTEN = 3  # of the pairs that are refined: a candidate that goes well with everything crowds others out


@dataclass(frozen=True, eq=False)
class Pair:
    """Two screened candidates, what they earn together, and where to start refining them."""

    members: tuple[Screened, Screened]
    log_evidence: float
    coefficients: tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"]]
    change: Float[np.ndarray, " size"]

    @property
    def key(self) -> frozenset[PlacedEffect]:
        """The two effects, in no order."""
        return frozenset(s.placed for s in self.members)


def pairs(fit: Fit, screened: Sequence[Screened]) -> list[Pair]:
    """Every pair of the candidates that explain most, best first; wrong-signed ones are left out.

    Of the same effect on the same element only one can stand. A pair stands with its best trials, which need not be the
    members' own best.
    """
    chosen = [t for s in screened for t in (s, *s.others) if t.response is not None]
    if len(chosen) < 2:
        return []
    system = _System.of(fit, chosen)
    best: dict[frozenset[PlacedEffect], Pair] = {}
    for i, j in combinations(range(len(chosen)), 2):
        pair, key = system.judge(i, j), frozenset((chosen[i].placed, chosen[j].placed))
        if pair is not None and (key not in best or pair.log_evidence > best[key].log_evidence):
            best[key] = pair
    return sorted(best.values(), key=lambda p: -p.log_evidence)


def varied(found: Sequence[Pair], count: int) -> list[Pair]:
    """The best of the pairs, none of whose members is in more than MOST_OFTEN of them."""
    out: list[Pair] = []
    seen: Counter[PlacedEffect] = Counter()
    for pair in found:
        members = [s.placed for s in pair.members]
        if len(out) < count and all(seen[m] < MOST_OFTEN for m in members):
            out.append(pair)
            seen.update(members)
    return out


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of the fit's unknowns and all candidates' columns."""

    fit: Fit
    chosen: Sequence[Screened]
    columns: list[np.ndarray]  # of each candidate, in gram
    gram: Float[np.ndarray, "k k"]
    slope: Float[np.ndarray, " k"]

    @classmethod
    def of(cls, fit: Fit, chosen: Sequence[Screened]) -> "_System":
        lin, size = fit.linear, fit.problem.size
        r = lin.latent.project(lin.stacked)[..., 0]
        x = np.concatenate(
            [lin.latent.project(lin.columns), *(s.response for s in chosen if s.response is not None)], -1
        )
        ends = np.cumsum([size, *(len(s.coefficients) for s in chosen)])
        columns = [np.arange(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        flat = x.reshape(-1, x.shape[-1])
        return cls(fit, chosen, columns, flat.T @ flat, flat.T @ r.reshape(-1))

    def judge(self, i: int, j: int) -> Pair | None:
        a, b = self.chosen[i], self.chosen[j]
        if a.placed.effect.name == b.placed.effect.name and a.placed.element == b.placed.element:
            return None
        size, k = self.fit.problem.size, len(self.columns[i])
        at = np.concatenate([np.arange(size), self.columns[i], self.columns[j]])
        sd = np.concatenate([np.full(len(s.coefficients), s.trial.sd) for s in (a, b)])
        positive = np.concatenate([one_sided(s.placed, s.trial) for s in (a, b)])
        found = add(self.fit, self.gram[np.ix_(at, at)], self.slope[at], sd, positive)
        if found is None:
            return None
        parts = found.coefficients[:k], found.coefficients[k:]
        if any(not p.any() for p in parts):  # one of them is wrong-signed
            return None
        return Pair((a, b), found.log_evidence, parts, found.change)
