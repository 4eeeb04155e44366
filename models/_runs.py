"""Episodes of a scene, as its modules simulate them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.transitions import Transitions


@dataclass(frozen=True, eq=False)
class Runs:
    """States as measured, the commands between them, and what the simulator's own state was."""

    states: Float[np.ndarray, "episodes samples s"]
    actions: Float[np.ndarray, "episodes steps a"]
    full: Float[np.ndarray, "episodes samples f"]  # qpos and qvel; f = 0 where a measured state is whole

    @cached_property
    def transitions(self) -> Transitions:
        """All of them, row by row."""
        return Transitions.of_episodes(self.states, self.actions)

    @property
    def before(self) -> Float[np.ndarray, "rows f"]:
        """The simulator's own state that each transition begins with."""
        return self.full[:, :-1].reshape(-1, self.full.shape[-1])

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, rows: slice) -> Self:
        return type(self)(self.states[rows], self.actions[rows], self.full[rows])
