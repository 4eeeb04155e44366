"""Every effect of the catalogue on every element of a model that it can sit on."""

from det2stoc_bayes.engines.magnitudes import Magnitudes
from det2stoc_bayes.mismatch.effects import CATALOGUE, PlacedEffect
from det2stoc_bayes.problem import Problem


def candidates(problem: Problem) -> list[PlacedEffect]:
    """Placed effects, with prior scales from the believed model's own simulation."""
    magnitudes = Magnitudes(problem)
    return [
        PlacedEffect([form for form in effect.forms() if form.fits(element)][-1], place, magnitudes.of(element))
        for effect in CATALOGUE.values()
        if effect.kind != "simulator"
        for others in [problem.simulator.elements(effect.kind, problem.segments.columns)]
        for element in others
        if effect.fits(element)
        for place in effect.places(element, others)
    ]
