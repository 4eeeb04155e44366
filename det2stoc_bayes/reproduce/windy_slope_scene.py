"""Windy Slope as an experiment's scene."""

from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.models import windy_slope
from det2stoc_bayes.models._runs import Runs
from det2stoc_bayes.reproduce.scene import Report, Scene


class WindySlope(Scene):
    """Nothing is commanded or measured with noise, and every episode begins alike."""

    title = "Windy Slope"
    model = windy_slope.MODEL
    names, units, state = windy_slope.NAMES, windy_slope.UNITS, windy_slope.STATE
    shown = tuple(range(len(windy_slope.STATE)))
    place, matrix = 0, windy_slope.STATE.index("R00")
    box, block, depth = (0.5, 0.5, 0.5), (0.25, 0.5, 0.25), 0.25
    num_steps, least = windy_slope.NUM_STEPS, windy_slope.LEAST
    reality, prior = windy_slope.REALITY, windy_slope.PRIOR
    one_start = True
    real_episodes = (6, 8, 10, 10, 10)
    source = {
        "baseline 1000": (69.42, 1.73), "baseline 10000": (80.35, 0.60), "det2stoc 1": (66.93, 0.54),
        "det2stoc 2": (78.65, 0.53), "det2stoc 3": (81.74, 0.61),
    }  # fmt: skip
    oracles = {"population": "its population", "state": "p(psi | state)"}

    def simulate(self, psi: Float[np.ndarray, "episodes psi"], random: np.random.Generator, progress: Report) -> Runs:
        states = windy_slope.simulate(psi, progress=progress)
        nothing = np.zeros((*states.shape[:2], 0))
        return Runs(states, nothing[:, 1:], nothing)  # a state is whole

    def change(
        self, runs: Runs, psi: Float[np.ndarray, "rows psi"], rows: Any = slice(None)
    ) -> Float[np.ndarray, "rows s"]:
        start = windy_slope.full_state(runs.transitions.state[rows])
        return np.diff(windy_slope.simulate(psi, num_steps=1, start=start), axis=1)[:, 0]

    def swept(self, psi: Float[np.ndarray, "episodes psi"]) -> Float[np.ndarray, "episodes samples 3"]:
        return windy_slope.simulate(psi)[..., :3]


SCENE = WindySlope()
