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
type Defects = tuple[np.ndarray, np.ndarray]  # of states and of columns, over each interval, as a response has them


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
    return _way(placed) is None and not placed.effect.uses("reading") and not placed.effect.uses("control")


def of_motion(
    response: Response, placed: PlacedEffect, tried: Sequence[Values]
) -> Float[np.ndarray, "segments values columns"]:
    """What an effect on the motion changes, for each of these parameter values."""
    way = _way(placed)
    if way is None:
        return response.propagate(*response.defects([(placed, values) for values in tried]))
    return response.propagate(*way(response, placed, tried))


def _way(placed: PlacedEffect) -> Callable[[Response, PlacedEffect, Sequence[Values]], Defects] | None:
    """By what an effect makes its defects without a simulation of its own, if there is such a way."""
    effect = placed.effect
    if effect.uses("joint_force") or (effect.uses("force_along") and "plain" in placed.element.traits):
        return _forced
    if effect.uses("friction"):
        return _rubbed
    if effect.uses("gravity"):
        return _pulled
    if effect.uses("swell"):
        return _swelled
    if effect.uses("body_force"):
        return _pushed
    if effect.uses("control") and not effect.uses("memory"):  # of this sample's command alone
        return _commanded
    return None


def _forced(response: Response, placed: PlacedEffect, tried: Sequence[Values]) -> Defects:
    effect, at, given = placed.effect, placed.element, _arrays(tried)
    inside = response.joint_states(at)
    force = np.stack([effect.force_along(p, inside).mean(-1) for p in given], -1)
    d, e = response.forced(at.dof, force)
    if at.source:
        back = np.stack([effect.reaction(p, inside, np).mean(-1) for p in given], -1)
        d, e = (a + b for a, b in zip((d, e), response.forced(at.source_dof, back), strict=True))
    return d, e


def _rubbed(response: Response, placed: PlacedEffect, tried: Sequence[Values]) -> Defects:
    inside = response.joint_states(placed.element)
    size = np.stack([placed.effect.friction(p, inside, np).mean(-1) for p in _arrays(tried)], -1)
    return response.rubbed(placed.element.dof, size, placed.typical)


def _pulled(response: Response, placed: PlacedEffect, tried: Sequence[Values]) -> Defects:
    felt = [placed.effect.gravity(p, response.moments(), np).mean(2) for p in _arrays(tried)]
    return response.pulled(np.stack(felt, -1))


def _swelled(response: Response, placed: PlacedEffect, tried: Sequence[Values]) -> Defects:
    parts = [placed.effect.swell(p, response.moments(), np).mean(2) for p in _arrays(tried)]
    return response.swelled(placed, np.stack(parts, -1))


def _pushed(response: Response, placed: PlacedEffect, tried: Sequence[Values]) -> Defects:
    return response.pushed(placed.effect, placed.element, _arrays(tried))


def _commanded(response: Response, placed: PlacedEffect, tried: Sequence[Values]) -> Defects:
    return response.commanded(placed.element, placed.effect, tried)


def _arrays(tried: Sequence[Values]) -> list[dict[str, np.ndarray]]:
    return [{n: np.asarray(v, float) for n, v in values.items()} for values in tried]


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
