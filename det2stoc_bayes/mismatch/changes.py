"""What every trial of every candidate changes of the prediction, to first order, by the cheapest way there is."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import EffectRows
from det2stoc_bayes.mismatch.effects.base import PlacedEffect, Trial
from det2stoc_bayes.mismatch.response import Response
from det2stoc_bayes.optimize import Fit

MAX_COLUMNS = 128  # held at once

Values = Mapping[str, Any]


class Changes:
    """Changes of a fit's prediction by trials, starts held. Forces and commands cost no simulation of their own."""

    def __init__(self, fit: Fit):
        self._response, self._readings = Response(fit), _Readings(fit)

    def of(
        self, placed: PlacedEffect, trials: Sequence[Trial]
    ) -> Iterator[tuple[Trial, Float[np.ndarray, "segments values columns"]]]:
        """Each trial of an effect with what its columns change."""
        while trials:
            some = trials[: max(MAX_COLUMNS // len(trials[0].columns), 1)]
            trials = trials[len(some) :]
            tried = [dict(values) for trial in some for values in trial.columns]
            columns = iter(np.moveaxis(_columns(self._response, self._readings, placed, tried), -1, 0))
            for trial in some:
                yield trial, np.stack([next(columns) for _ in trial.columns], -1)

    def every(
        self, candidates: Sequence[PlacedEffect], advance: Callable[[int], None] = lambda n: None
    ) -> Iterator[tuple[PlacedEffect, Trial, Float[np.ndarray, "segments values columns"]]]:
        """All trials of all candidates, one candidate after the other."""
        for placed in candidates:
            for trial, columns in self.of(placed, placed.effect.trials(placed.typical)):
                yield placed, trial, columns
            advance(1)


def changes(
    fit: Fit, candidates: Sequence[PlacedEffect], advance: Callable[[int], None] = lambda n: None
) -> Iterator[tuple[PlacedEffect, Trial, Float[np.ndarray, "segments values columns"]]]:
    """Change of the prediction by every trial of every candidate."""
    return Changes(fit).every(candidates, advance)


def _columns(response: Response, readings: "_Readings", placed: PlacedEffect, tried: Sequence[Values]) -> np.ndarray:
    if placed.effect.uses("reading") or placed.effect.uses("sample_time"):
        return np.stack([readings.change(placed, values) for values in tried], -1)
    return of_motion(response, placed, tried)


def of_constants(placed: PlacedEffect) -> bool:
    """Whether an effect is one of the model's constants alone, so that `of_motion` simulates each interval with it."""
    effect, plain = placed.effect, "plain" in placed.element.traits
    told = ("reading", "joint_force", "friction", "gravity", "swell", "body_force", "control")
    return not any(effect.uses(name) for name in told) and not (effect.uses("force_along") and plain)


def of_motion(
    response: Response, placed: PlacedEffect, tried: Sequence[Values]
) -> Float[np.ndarray, "segments values columns"]:
    """What an effect on the motion changes, for each of these parameter values."""
    effect, at = placed.effect, placed.element
    given = [{n: np.asarray(v, float) for n, v in values.items()} for values in tried]
    if effect.uses("joint_force") or (effect.uses("force_along") and "plain" in at.traits):
        inside = response.joint_states(at)
        force = np.stack([effect.force_along(p, inside).mean(-1) for p in given], -1)
        d, e = response.forced(at.dof, force)
        if at.source:
            back = np.stack([effect.reaction(p, inside, np).mean(-1) for p in given], -1)
            d, e = (a + b for a, b in zip((d, e), response.forced(at.source_dof, back), strict=True))
        return response.propagate(d, e)
    if effect.uses("friction"):
        inside = response.joint_states(at)
        size = np.stack([effect.friction(p, inside, np).mean(-1) for p in given], -1)
        return response.propagate(*response.rubbed(at.dof, size, placed.typical))
    if effect.uses("gravity"):
        felt = [effect.gravity(p, response.moments(), np).mean(2) for p in given]
        return response.propagate(*response.pulled(np.stack(felt, -1)))
    if effect.uses("swell"):
        parts = [effect.swell(p, response.moments(), np).mean(2) for p in given]
        return response.propagate(*response.swelled(placed, np.stack(parts, -1)))
    if effect.uses("body_force"):
        return response.propagate(*response.pushed(effect, at, given))
    if effect.uses("control") and not effect.uses("memory"):  # of this sample's command alone
        return response.propagate(*response.commanded(at, effect, tried))
    return response.propagate(*response.defects([(placed, values) for values in tried]))


class _Readings:
    """Changes of what is recorded while the motion stays the same."""

    def __init__(self, fit: Fit):
        self.fit, self._plain = fit, None

    def change(self, placed: PlacedEffect, values: Values) -> Float[np.ndarray, "segments values"]:
        """An effect's own, by reading the same motion again."""
        if self._plain is None:
            self._plain = self._predicted()
        segments, at = self.fit.problem.segments, placed.element
        if placed.effect.uses("sample_time"):
            moved = self._predicted(EffectRows.alike(placed, segments.count, values))
        else:
            moved, j = self._plain.copy(), segments.columns.index(at.column)
            given = {n: np.full(segments.count, v) for n, v in values.items()}
            moved[..., j] = placed.effect.reading(given, segments.time, moved[..., j], np)
        problem = self.fit.problem
        both = problem.residuals(np.concatenate([self._plain, moved]))
        return both[: segments.count] - both[segments.count :]

    def _predicted(self, *added: EffectRows) -> Float[np.ndarray, "segments samples columns"]:
        problem, point = self.fit.problem, self.fit.point
        request = problem.request(point.z[None], point.start)
        return problem.simulator.rollout(replace(request, effects=(*request.effects, *added)))
