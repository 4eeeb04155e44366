"""YuMi Pusher as an experiment's scene."""

from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.models import yumi_pusher
from det2stoc_bayes.models._runs import Runs
from det2stoc_bayes.models.yumi_pusher_policy import Pusher
from det2stoc_bayes.reproduce.scene import Report, Scene


class YumiPusher(Scene):
    """Closed loop from random starts; states are measured with noise, which the pusher sees as well."""

    title = "YuMi Pusher"
    model = yumi_pusher.MODEL
    names, units, state, blocks = yumi_pusher.NAMES, yumi_pusher.UNITS, yumi_pusher.STATE, yumi_pusher.BLOCKS
    shown = tuple(range(yumi_pusher.STATE.index("x"), len(yumi_pusher.STATE)))
    place, matrix = yumi_pusher.STATE.index("x"), yumi_pusher.STATE.index("R00")
    box, block, depth = (0.03, 0.079, 0.105), (0.03, 0.075, 0.02), 0.085
    num_steps, least = yumi_pusher.NUM_STEPS, yumi_pusher.LEAST
    reality, prior = yumi_pusher.REALITY, yumi_pusher.PRIOR
    one_start = False
    real_episodes = (6, 8, 10)
    source = {
        "baseline 1000": (472.45, 11.54), "baseline 100000": (653.85, 8.91), "det2stoc 1": (629.12, 12.0),
        "det2stoc 2": (716.43, 12.0), "det2stoc 3": (769.14, 12.0),
    }  # fmt: skip
    oracles = {"population": "its population", "known": "the truth"}

    def simulate(self, psi: Float[np.ndarray, "episodes psi"], random: np.random.Generator, progress: Report) -> Runs:
        start = yumi_pusher.drawn_starts(random, len(psi))
        return yumi_pusher.simulate(psi, start, lambda _: Pusher(random), random, progress=progress)

    def change(
        self, runs: Runs, psi: Float[np.ndarray, "rows psi"], rows: Any = slice(None)
    ) -> Float[np.ndarray, "rows s"]:
        before, actions = runs.before[rows], runs.transitions.action[rows]
        after = yumi_pusher.after(psi, before, actions[:, None])[:, 1]
        return yumi_pusher.state_of(after) - runs.transitions.state[rows]

    def swept(self, psi: Float[np.ndarray, "episodes psi"]) -> Float[np.ndarray, "episodes samples 3"]:
        """Under the commands of one episode."""
        shown = self.simulate(np.array([self.reality.loc]), np.random.default_rng(0), lambda *_: None)
        start, actions = np.tile(shown.full[0, 0], (len(psi), 1)), np.tile(shown.actions, (len(psi), 1, 1))
        return yumi_pusher.after(psi, start, actions)[..., :3]

    def noise_variance(self, state: Float[np.ndarray, "rows s"]) -> Float[np.ndarray, "rows s"]:
        return yumi_pusher.noise_variance(state)


SCENE = YumiPusher()
