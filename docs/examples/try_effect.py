"""Simulates a study with an effect on one joint, at a given size."""

import numpy as np

from det2stoc_bayes.engines.base import EffectRows
from det2stoc_bayes.engines.elements import joint_elements
from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.effects import Effect, PlacedEffect, Typical
from det2stoc_bayes.problem import Problem


def predicted(problem: Problem, effect: Effect, values: dict[str, float]) -> np.ndarray:
    """Predictions (segments, samples, columns) with the effect on the first joint, psi at its prior's median."""
    placed = PlacedEffect(effect, joint_elements(problem.simulator.model)[0], Typical())
    psi = problem.psi_by_segment(np.zeros(problem.size))
    everywhere = slice(0, len(psi))
    rows = EffectRows(placed, everywhere, {name: np.full(len(psi), value) for name, value in values.items()})
    return problem.simulator.rollout(problem.request_under(psi, start_point(problem).start, (rows,)))
