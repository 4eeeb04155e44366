"""Every listed effect of the catalogue on every element of a model that it can sit on."""

from collections.abc import Sequence

from det2stoc_bayes.engines.magnitudes import Magnitudes
from det2stoc_bayes.mismatch.effects import CATALOGUE, Element, PlacedEffect
from det2stoc_bayes.mismatch.effects.elements import Kind
from det2stoc_bayes.problem import Problem


def candidates(problem: Problem, touching: Sequence[Element] = ()) -> list[PlacedEffect]:
    """Placed effects, with prior scales from the believed model's own simulation; `touching`: contacts seen there."""
    magnitudes = Magnitudes(problem)
    return [
        PlacedEffect(effect.form_on(element), place, magnitudes.of(element))
        for effect in CATALOGUE.values()
        if effect.kind != "simulator" and effect.listed
        for others in [_elements(problem, effect.kind, touching)]
        for element in others
        if effect.fits(element)
        for place in effect.places(element, others)
    ]


def _elements(problem: Problem, kind: Kind, touching: Sequence[Element]) -> Sequence[Element]:
    return touching if kind == "contact" else problem.simulator.elements(kind, problem.segments.columns)
