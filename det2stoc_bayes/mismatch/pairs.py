"""Two additions at once: where each of two effects is hidden by the lack of the other, neither is found alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.evidence import profile
from det2stoc_bayes.mismatch.screen import Screened
from det2stoc_bayes.optimize import Fit, noise_scale

MOST = 40  # candidates that are paired


@dataclass(frozen=True, eq=False)
class Pair:
    """Two screened candidates, what they earn together, and where to start refining them."""

    members: tuple[Screened, Screened]
    log_evidence: float
    coefficients: tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"]]
    change: Float[np.ndarray, " size"]


def pairs(fit: Fit, screened: Sequence[Screened]) -> list[Pair]:
    """Every pair of the candidates that explain most, best first; wrong-signed ones are left out.

    Of the same effect on the same element only one can stand, and a candidate stands with its own best trial.
    """
    chosen = sorted((s for s in screened if s.response is not None), key=lambda s: -s.gain)[:MOST]
    system = _System.of(fit, chosen)
    found = [p for i, j in combinations(range(len(chosen)), 2) if (p := system.judge(i, j)) is not None]
    return sorted(found, key=lambda p: -p.log_evidence)


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
        size, z = self.fit.problem.size, self.fit.point.z
        at = np.concatenate([np.arange(size), self.columns[i], self.columns[j]])
        whole, total = self.gram[np.ix_(at, at)], self.slope[at]
        k = len(at) - size
        spread = np.concatenate([np.full(len(s.coefficients), s.trial.sd**-2.0) for s in (a, b)])
        pull, prior = np.concatenate([-z, np.zeros(k)]), np.concatenate([np.ones(size), spread])
        s2 = self.fit.noise_scale
        for _ in range(4):  # the noise scale and the coefficients determine each other
            precision = whole / s2 + np.diag(prior)
            step = np.linalg.solve(precision, total / s2 + pull)
            chi2 = self.fit.chi2 - 2 * float(total @ step) + float(step @ whole @ step)
            s2 = noise_scale(self.fit.linear, max(chi2, 1e-9), True)
        parts = step[size : size + len(self.columns[i])], step[size + len(self.columns[i]) :]
        if any(s.one_sided and len(c) == 1 and c[0] < 0 for s, c in zip((a, b), parts, strict=True)):
            return None
        n = self.fit.linear.degrees_of_freedom
        penalty = float((spread * step[size:] ** 2).sum()) + float(((z + step[:size]) ** 2 - z**2).sum())
        occam = np.linalg.slogdet(precision)[1] + np.linalg.slogdet(self.fit.covariance)[1] - np.log(spread).sum()
        earned = profile(self.fit.chi2, self.fit.noise_scale, n) - profile(chi2, s2, n) - 0.5 * (penalty + float(occam))
        return Pair((a, b), float(earned), parts, step[:size])
