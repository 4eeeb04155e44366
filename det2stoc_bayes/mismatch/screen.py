"""Ranking every effect on every element by the evidence that a first-order change of the prediction earns."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import EffectRows
from det2stoc_bayes.mismatch.effects.base import PlacedEffect, Trial
from det2stoc_bayes.mismatch.evidence import profile
from det2stoc_bayes.mismatch.response import Response
from det2stoc_bayes.optimize import Fit, noise_scale
from det2stoc_bayes.problem import merge_requests

WRONG_SIGN = -0.69  # nats of a candidate whose coefficient has a sign that it cannot have
MAX_COLUMNS = 128  # responses held at once


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

    @property
    def one_sided(self) -> bool:
        """Whether a negative coefficient is no effect."""
        return self.placed.effect.parameters[0].positive or self.trial.one_sided


def screen(
    fit: Fit, candidates: Sequence[PlacedEffect], advance: Callable[[int], None] = lambda n: None
) -> list[Screened]:
    """Every candidate's best trial, best first. Trials whose simulation diverges are passed over.

    With the fit's own columns beside a trial's, an effect that psi can absorb earns nothing.
    """
    best: dict[PlacedEffect, Screened] = {}
    there = {(e.effect.name, e.element) for e in fit.problem.effects}
    new = [c for c in candidates if (c.effect.name, c.element) not in there]
    for placed, trial, columns in responses(fit, new, advance):
        found = _judge(fit, placed, trial, columns)
        if found is not None and (placed not in best or found.log_evidence > best[placed].log_evidence):
            best[placed] = found
    return sorted(best.values(), key=lambda s: -s.log_evidence)


def responses(fit: Fit, candidates, advance) -> Iterator[tuple[PlacedEffect, Trial, np.ndarray]]:
    """Change of the prediction (segments, values, k) by every trial."""
    response = Response(fit)
    for placed in candidates:
        effect, at = placed.effect, placed.element
        trials = effect.trials(placed.typical)
        if effect.uses("reading") or effect.uses("sample_time"):
            changes = _recorded(fit, placed, trials)
        else:
            flat = [dict(values) for trial in trials for values in trial.columns]
            parts = []
            for begin in range(0, len(flat), MAX_COLUMNS):
                some = flat[begin : begin + MAX_COLUMNS]
                if effect.uses("joint_force"):
                    inside = response.joint_states(at.qpos, at.dof)
                    force = np.stack(
                        [
                            effect.joint_force({n: np.asarray(v) for n, v in t.items()}, inside, np).mean(-1)
                            for t in some
                        ],
                        -1,
                    )
                    parts.append(response.propagate(*response.forced(at.dof, force)))
                elif effect.uses("control") and not effect.uses("memory"):  # of this sample's command alone
                    parts.append(response.propagate(*response.commanded(at, effect, some)))
                else:
                    parts.append(response.propagate(*response.defects([(placed, t) for t in some])))
            columns = iter(np.moveaxis(np.concatenate(parts, -1), -1, 0))
            changes = [np.stack([next(columns) for _ in trial.columns], -1) for trial in trials]
        yield from zip([placed] * len(trials), trials, changes, strict=True)
        advance(1)


def _recorded(fit: Fit, placed: PlacedEffect, trials: Sequence[Trial]) -> list[np.ndarray]:
    """Columns of an effect on what is recorded: simulated, since the motion stays the same."""
    problem, count = fit.problem, fit.problem.segments.count
    request = problem.request(fit.point.z[None], fit.point.start)
    requests = [request]
    for trial in trials:
        for values in trial.columns:
            requests.append(replace(request, effects=(*request.effects, EffectRows.alike(placed, count, values))))
    moved = -problem.residuals(problem.simulator.rollout(merge_requests(requests))).reshape(len(requests), count, -1)
    columns = iter(moved[1:] - moved[0])
    return [np.stack([next(columns) for _ in trial.columns], -1) for trial in trials]


def _judge(fit: Fit, placed: PlacedEffect, trial: Trial, columns: np.ndarray) -> Screened | None:
    """Closed-form evidence of [current unknowns, trial coefficients] against the current unknowns alone."""
    if not np.isfinite(columns).all():
        return None
    lin = fit.linear
    x = lin.latent.project(lin.latent.stack(columns))
    j, r = lin.latent.project(lin.columns), lin.latent.project(lin.stacked)[..., 0]
    both = np.concatenate([j, x], -1)
    gram = np.einsum("snk,snl->kl", both, both)
    slope = np.einsum("snk,sn->k", both, r)
    d, k = lin.problem.size, columns.shape[-1]
    s2 = fit.noise_scale
    # Residuals were taken at the fit's optimum, where the prior pulls by -z.
    pull = np.concatenate([-lin.point.z, np.zeros(k)])
    prior = np.concatenate([np.ones(d), np.full(k, trial.sd**-2.0)])
    for _ in range(4):  # the noise scale and the coefficients determine each other
        precision = gram / s2 + np.diag(prior)
        step = np.linalg.solve(precision, slope / s2 + pull)
        chi2 = fit.chi2 - 2 * float(slope @ step) + float(step @ gram @ step)
        s2 = noise_scale(lin, max(chi2, 1e-9), True)
    found = Screened(placed, trial, WRONG_SIGN, fit.chi2 - chi2, np.zeros(k), np.zeros(d), x)
    if found.one_sided and k == 1 and step[d] < 0:
        return found
    n = lin.degrees_of_freedom
    penalty = float((prior[d:] * step[d:] ** 2).sum()) + float(((lin.point.z + step[:d]) ** 2 - lin.point.z**2).sum())
    occam = (
        np.linalg.slogdet(precision)[1] - np.linalg.slogdet(np.linalg.inv(fit.covariance))[1] - np.log(prior[d:]).sum()
    )
    log_evidence = profile(fit.chi2, fit.noise_scale, n) - profile(chi2, s2, n) - 0.5 * penalty - 0.5 * float(occam)
    return replace(found, log_evidence=float(log_evidence), coefficients=step[d:], change=step[:d])
