"""Posterior predictive check: whether data that the corrected simulator makes would leave as large an error.

The error is each channel's sum of squared whitened residuals, initial states and unknowns fitted. Replicated noise is
fitted likewise, by the linearization, so that p-values are uniform under the right model (a check at fixed psi, with
residuals that psi was fitted to, would hardly ever reject). Where noise is not given its size says nothing, and
residuals must be white.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from det2stoc_bayes.mismatch.glitches import lone_errors
from det2stoc_bayes.mismatch.whiteness import Whiteness, whiteness
from det2stoc_bayes.optimize import Fit

FAILS = 0.01  # p-value, corrected for the number of channels, below which something is unexplained
NUM_REPLICATES = 200
MAX_VALUES = 8_000_000  # numbers of replicated noise held at once
REMEDY = 'With noise = "student_t" in [likelihood] such glitches lose their weight.'


@dataclass(frozen=True, eq=False)
class PredictiveCheck:
    """One p-value a channel; NaN where its noise was not given."""

    columns: tuple[str, ...]
    p_values: Float[np.ndarray, " columns"]
    inflation: Float[np.ndarray, " columns"]  # squared error over what noise would leave
    white: Whiteness
    glitches: tuple[float, ...] = ()  # noise sds off of lone samples, where they are most of what is unexplained

    @property
    def given(self) -> np.ndarray:
        """Channels whose noise the study gives."""
        return np.isfinite(self.p_values)

    @property
    def p_value(self) -> float:
        """Of all channels together (Bonferroni): the error's size, or its whiteness where no noise is given."""
        given = self.p_values[self.given]
        return float(min(1.0, len(given) * given.min())) if len(given) else self.white.p_value

    @property
    def worst(self) -> str | None:
        """The channel that is explained least."""
        if not self.given.any():
            return self.white.worst
        return self.columns[int(np.nanargmin(np.where(self.given, self.p_values - self.inflation, np.nan)))]

    @property
    def fails(self) -> bool:
        """Whether something stays unexplained."""
        return self.p_value < FAILS

    def text(self) -> str:
        """What stays unexplained, in a sentence; empty where the check passes."""
        if not self.fails:
            return ""
        if not self.given.any():
            return f"The error on {self.worst} that stays unexplained is no white noise."
        if self.glitches:
            count, most = len(self.glitches), f"{max(self.glitches):.0f} noise sds off"
            what = f"a lone sample is {most}" if count == 1 else f"{count} samples, each alone, are up to {most}"
            return f"Most of what stays unexplained: {what}. {REMEDY}"
        ratio = self.inflation[self.columns.index(str(self.worst))]
        return f"Part of {self.worst} stays unexplained: its squared error is {ratio:.3g} times the noise's."

    def summary(self) -> dict[str, Any]:
        """For diagnosis.json."""
        return {
            "p_value": self.p_value,
            "worst_channel": self.worst,
            "channels": dict(zip(self.columns, self.p_values.tolist(), strict=True)),
            "inflation": dict(zip(self.columns, self.inflation.tolist(), strict=True)),
            "whiteness": {"p_value": self.white.p_value, "worst_channel": self.white.worst},
        }


def check(fit: Fit, seed: int, num_replicates: int = NUM_REPLICATES) -> PredictiveCheck:
    """Of a fit, at its most probable point."""
    columns = fit.problem.segments.columns
    observed = _by_column(fit, fit.linear.latent.project(fit.linear.stacked))[:, 0]
    replicated = _replicated(fit, np.random.default_rng(seed), num_replicates)
    mean, variance = replicated.mean(1), np.maximum(replicated.var(1, ddof=1), 1e-300)
    mean = np.maximum(mean, 1e-300)
    p = stats.gamma.sf(observed, mean**2 / variance, scale=variance / mean)  # chi2 with its moments
    given = np.array([c in fit.problem.simulator.study.noise for c in columns])
    found = PredictiveCheck(columns, np.where(given, p, np.nan), observed / mean, whiteness(fit))
    return replace(found, glitches=lone_errors(fit)) if found.fails and given.any() else found


def _replicated(fit: Fit, random: np.random.Generator, count: int) -> Float[np.ndarray, "columns replicates"]:
    """Squared residuals of noise under the model, once starts and unknowns are fitted to it."""
    lin, problem = fit.linear, fit.problem
    j, size = lin.latent.project(lin.columns), problem.size
    precision = np.einsum("snk,snl->kl", j, j) + np.eye(size)
    chunk, out = max(1, MAX_VALUES // (j.shape[0] * j.shape[1])), []
    for begin in range(0, count, chunk):
        n = min(chunk, count - begin)
        noise = random.standard_normal((*lin.stacked.shape[:2], n))
        values = problem.weight.shape[1]
        noise[:, :values] = _scatter(problem, random, noise[:, :values])
        r = lin.latent.project(noise)
        pull = np.einsum("snk,snp->kp", j, r) + random.standard_normal((size, n))
        out.append(_by_column(fit, r - j @ np.linalg.solve(precision, pull)))
    return np.concatenate(out, 1)


def _scatter(problem, random: np.random.Generator, normal: np.ndarray) -> np.ndarray:
    """Bent noise of every recorded value, 0 elsewhere."""
    nu = problem.measurement.degrees_of_freedom
    drawn = normal if nu is None else problem.measurement.bend(random.standard_t(nu, normal.shape))
    return np.where(problem.weight[..., None] > 0, drawn, 0.0)


def _by_column(
    fit: Fit, r: Float[np.ndarray, "segments stacked replicates"]
) -> Float[np.ndarray, "columns replicates"]:
    count, values = fit.problem.segments.count, fit.problem.weight.shape[1]
    shape = (count, -1, len(fit.problem.segments.columns), r.shape[2])
    return (r[:, :values].reshape(shape) ** 2).sum((0, 1))
