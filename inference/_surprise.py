"""Whether recordings lie among the simulations that a decoder learned from, before any posterior is believed.

The surprise is what the frozen decoder lacks in log density at the psi that suits the recordings best: one psi for all
of them, or one a stretch where it varies by recording. Fresh simulations of all stretches under psi of the training's
population are scored likewise, so that a right model has a p-value that is uniform: a rank among its like.
"""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.inference._amortized import Iteration, Population
from det2stoc_bayes.inference._episodes import Episodes, summits
from det2stoc_bayes.study_transitions import StudyTransitions
from det2stoc_bayes.transitions import Transitions
from det2stoc_bayes.unknowns import population_draws

NUM_REFERENCES, FEWER = 199, 99  # simulated studies; of those with many stretches
MANY = 400  # stretches of a study
CLIMB = 15  # steps of Fisher scoring: heights stand before places do


@dataclass(frozen=True, eq=False)
class Surprise:
    """Mean surprise of a transition [nat], of the recordings and of simulated studies like them."""

    recorded: float
    simulated: Float[np.ndarray, " studies"]

    @property
    def p_value(self) -> float:
        """Share of studies, the recorded one among them, that are as surprising."""
        return float((1 + (self.simulated >= self.recorded).sum()) / (1 + len(self.simulated)))

    def told(self) -> dict[str, tuple[tuple[str, ...], Any]]:
        """As a group of a fit."""
        return {
            "recorded": ((), self.recorded),
            "simulated": (("study",), self.simulated),
            "p_value": ((), self.p_value),
        }


def surprise(turn: Iteration, transitions: StudyTransitions, random: np.random.Generator) -> Surprise:
    """How surprising a study's recordings are to the decoder of a turn whose population they did not shape."""
    count = transitions.stretches.count
    num = NUM_REFERENCES if count <= MANY else FEWER
    psi = _population(transitions, turn.believed, random, num)
    simulated = transitions.simulated(np.repeat(psi, count, axis=0), random)
    varies = any(p.varies == "trajectory" for p in transitions.problem.simulator.parameters)
    here, usual = (mean_surprise(turn, t, count, varies=varies) for t in (transitions.recorded_by_stretch(), simulated))
    return Surprise(float(here[0]), usual)


def _population(
    transitions: StudyTransitions, believed: Population, random: np.random.Generator, count: int
) -> Float[np.ndarray, "studies psi"]:
    parameters = transitions.problem.simulator.parameters
    normal = random.standard_normal((len(parameters), count)).T
    return population_draws(parameters, believed.loc, believed.scale, normal)


def mean_surprise(turn: Iteration, data: Transitions, count: int, *, varies: bool) -> Float[np.ndarray, " studies"]:
    """Surprise a transition; episodes count the stretches, `count` to a study."""
    x, y = turn.simulator.scaling.standard(data)
    study = data.episode // count
    episodes = Episodes.of(turn.cvae, x, y, data.episode if varies else study)
    start = jnp.zeros((len(episodes.x), turn.pretrained.latents), jnp.float32)
    height, *_ = summits(turn.pretrained, start, episodes.x, episodes.y, episodes.weight, CLIMB)
    owner = np.unique(data.episode) // count if varies else np.unique(study)
    return np.bincount(owner, -np.asarray(height, float)) / np.bincount(study)
