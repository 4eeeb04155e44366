"""Ranking every effect on every element by the evidence that a first-order change of the prediction earns."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.addition import add
from det2stoc_bayes.mismatch.changes import Changes
from det2stoc_bayes.mismatch.effects.base import PlacedEffect, Trial
from det2stoc_bayes.mismatch.sharpen import leads, sharpened, unlike
from det2stoc_bayes.optimize import Fit

WRONG_SIGN = -0.69  # nats of a candidate whose coefficient has a sign that it cannot have
MOST_PAIRED, MOST_TRIED = 40, 12  # candidates that are paired, and those of which all trials are
NUM_SHARPENED = 12  # candidates about whose best trials others are tried
NUM_STARTS = 5  # trials of each, from which the pattern search sets out
NUM_OTHERS = 3  # trials of an effect that are kept beside its best
FORGOTTEN_EVERY = 32  # trials: what explains least is dropped, for responses are large


@dataclass(frozen=True, eq=False)
class Screened:
    """A trial's evidence gain over the current fit, and the values from which to refine it."""

    placed: PlacedEffect
    trial: Trial
    log_evidence: float  # nats
    gain: float  # drop of whitened squared residual
    coefficients: Float[np.ndarray, " columns"]
    change: Float[np.ndarray, " size"]  # of the current unknowns, when the trial is added
    response: Float[np.ndarray, "segments stacked columns"] | None = None  # what no initial state explains of it
    others: tuple["Screened", ...] = ()  # the same effect's next best trials


def one_sided(placed: PlacedEffect, trial: Trial) -> Bool[np.ndarray, " columns"]:
    """Which coefficients are no effect where they are negative."""
    k = len(trial.columns)
    return np.full(k, trial.one_sided or (k == 1 and placed.effect.parameters[0].positive))


def screen(
    fit: Fit,
    candidates: Sequence[PlacedEffect],
    advance: Callable[[int], None] = lambda n: None,
    where: Fit | None = None,
) -> list[Screened]:
    """Every candidate's best trial, best first. Trials whose simulation diverges are passed over.

    With the fit's own columns beside a trial's, an effect that psi can absorb earns nothing. Responses are those at
    the fit, or at another one of the same samples that stands where it does.
    """
    trials: dict[PlacedEffect, list[Screened]] = {}
    beside = Beside(fit)
    there = {(e.effect.name, e.element) for e in fit.problem.effects}
    new = [c for c in candidates if (c.effect.name, c.element) not in there]
    by_trial = Changes(where or fit)
    for number, (placed, trial, columns) in enumerate(by_trial.every(new, advance), 1):
        found = beside.judge(placed, trial, columns)
        if found is not None:
            trials[placed] = _kept([*trials.get(placed, ()), found])
        if number % FORGOTTEN_EVERY == 0:
            _forget(trials)
    _forget(trials)
    for placed in sorted(trials, key=lambda placed: -trials[placed][0].log_evidence)[:NUM_SHARPENED]:
        trials[placed] = _sharpened(trials[placed], beside, by_trial)
    return sorted((replace(t[0], others=tuple(t[1:])) for t in trials.values()), key=lambda s: -s.log_evidence)


def _sharpened(trials: list[Screened], beside: "Beside", by_trial: Changes) -> list[Screened]:
    """An effect's trials and those to which a pattern search leads from the best that are unlike each other."""
    placed = trials[0].placed
    leading = [t for t in placed.effect.trials(placed.typical) if leads(placed, t)]
    if not leading:
        return trials

    def about(s: Screened, reach: float) -> list[Screened]:
        return _judged(placed, placed.effect.about(s.trial, placed.typical, reach), beside, by_trial)

    starts = _unlike(_judged(placed, leading, beside, by_trial), NUM_STARTS)
    found = [sharpened(s, about, lambda s: s.log_evidence) for s in starts]
    return _kept([*_unlike(found, NUM_STARTS), *trials])


def _judged(placed: PlacedEffect, trials: Sequence[Trial], beside: "Beside", by_trial: Changes) -> list[Screened]:
    """Trials of a sign that the effect can have; what diverges is none."""
    judged = (beside.judge(placed, trial, columns) for trial, columns in by_trial.of(placed, trials))
    return [s for s in judged if s is not None and s.coefficients.any()]


def _unlike(tried: Sequence[Screened], most: int) -> list[Screened]:
    """The best of all that change the prediction alike, best first."""

    def change(s: Screened) -> Float[np.ndarray, " values"]:
        return np.zeros(0) if s.response is None else (s.response @ s.coefficients).ravel()

    return unlike(sorted(tried, key=lambda s: -s.log_evidence), change, most)


def _kept(tried: Sequence[Screened]) -> list[Screened]:
    """An effect's best trials, best first: one of each number of columns, then the others."""
    order = sorted(tried, key=lambda s: -s.log_evidence)
    sizes = [len(s.trial.columns) for s in order]
    first = [s for i, s in enumerate(order) if sizes[i] not in sizes[:i]]
    rest = [s for i, s in enumerate(order) if sizes[i] in sizes[:i]]
    return sorted([*first, *rest][: 1 + NUM_OTHERS], key=lambda s: -s.log_evidence)


def _forget(trials: dict[PlacedEffect, list[Screened]]) -> None:
    """Drops responses, and further trials, of candidates that explain least: pairs are not made of them."""
    order = sorted(trials, key=lambda placed: -trials[placed][0].gain)
    for placed in order[MOST_TRIED:]:
        trials[placed] = trials[placed][:1]
    for placed in order[MOST_PAIRED:]:
        trials[placed] = [replace(trials[placed][0], response=None)]


class Beside:
    """A fit's normal equations, to which trials are added."""

    def __init__(self, fit: Fit):
        lin = fit.linear
        self.fit, self.latent = fit, lin.latent
        self.error = lin.latent.project(lin.stacked).ravel()
        self.columns = lin.latent.project(lin.columns).reshape(len(self.error), fit.problem.size)
        self.gram, self.slope = self.columns.T @ self.columns, self.columns.T @ self.error

    def gain(self, fit: Fit) -> float:
        """Drop of the squared residual by the last effect of a fit that stands where this one does, to first order."""
        x = self.latent.project(fit.linear.columns[..., self.fit.problem.size :]).reshape(len(self.error), -1)
        count = x.shape[1]
        found = add(self.fit, *self._with(x), np.ones(count), np.zeros(count, bool))
        return 0.0 if found is None else found.gain

    def judge(self, placed: PlacedEffect, trial: Trial, columns: np.ndarray) -> Screened | None:
        """Closed-form evidence of [current unknowns, trial coefficients] against the current unknowns alone."""
        if not np.isfinite(columns).all():
            return None
        response = self.latent.project(self.latent.stack(columns))
        x = response.reshape(-1, response.shape[-1])
        gram, slope = self._with(x)
        positive, sd = one_sided(placed, trial), np.full(x.shape[1], trial.sd)
        found = add(self.fit, gram, slope, sd, positive)
        if found is None:  # its sign may be right beside another effect
            free = add(self.fit, gram, slope, sd, ~positive & positive)
            gain, none = 0.0 if free is None else free.gain, np.zeros(len(positive))
            return Screened(placed, trial, WRONG_SIGN, gain, none, np.zeros(self.fit.problem.size), response)
        values = found.log_evidence, found.gain, found.coefficients, found.change
        return Screened(placed, trial, *values, response)

    def _with(self, x: Float[np.ndarray, "values columns"]) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
        """The normal equations with further columns."""
        cross = self.columns.T @ x
        return np.block([[self.gram, cross], [cross.T, x.T @ x]]), np.concatenate([self.slope, x.T @ self.error])
