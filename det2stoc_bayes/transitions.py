"""Transitions of a system: a state, an action, and how the state has changed one sample later."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

RIDGE = 1e-6  # beside inputs of variance 1


@dataclass(frozen=True, eq=False)
class Transitions:
    """Rows (s, a, s' - s), and the episode that each one is of."""

    state: Float[np.ndarray, "rows s"]
    action: Float[np.ndarray, "rows a"]
    change: Float[np.ndarray, "rows s"]
    episode: Int[np.ndarray, " rows"]

    @classmethod
    def of_episodes(
        cls,
        states: Float[np.ndarray, "episodes samples s"],
        actions: Float[np.ndarray, "episodes steps a"] | None = None,
    ) -> "Transitions":
        """All transitions of episodes of one length."""
        episodes, samples, size = states.shape
        given = np.zeros((episodes, samples - 1, 0)) if actions is None else actions
        return cls(
            states[:, :-1].reshape(-1, size),
            given.reshape(episodes * (samples - 1), given.shape[-1]),
            np.diff(states, axis=1).reshape(-1, size),
            np.repeat(np.arange(episodes), samples - 1),
        )

    def __len__(self) -> int:
        return len(self.state)

    def __getitem__(self, rows) -> "Transitions":
        return Transitions(self.state[rows], self.action[rows], self.change[rows], self.episode[rows])

    @property
    def given(self) -> Float[np.ndarray, "rows x"]:
        """What a change is predicted from."""
        return np.concatenate([self.state, self.action], 1)


@dataclass(frozen=True, eq=False)
class Scaling:
    """Units in which networks see inputs and changes: standard, and changes less what is linear in the inputs.

    Networks then learn what is left: of a body in motion mostly how its speed, not its place, will change.
    """

    given_mean: Float[np.ndarray, " x"]
    given_sd: Float[np.ndarray, " x"]
    gain: Float[np.ndarray, "inputs y"]  # inputs: standard x, and 1
    change_sd: Float[np.ndarray, " y"]  # of what is left

    @classmethod
    def of(cls, data: Transitions, *, linear: bool = True, floor: float = 1e-9) -> "Scaling":
        """From all rows; what never changes keeps its unit. The linear part is a ridge regression or a mean."""
        mean, sd = data.given.mean(0), data.given.std(0)
        sd = np.where(sd > floor, sd, 1.0)
        inputs = _with_one((data.given - mean) / sd * linear)
        precision = inputs.T @ inputs + RIDGE * len(inputs) * np.eye(inputs.shape[1])
        gain = np.linalg.solve(precision, inputs.T @ data.change)
        left = (data.change - inputs @ gain).std(0)
        return cls(mean, sd, gain, np.where(left > floor, left, 1.0))

    def inputs(self, given: Float[np.ndarray, "rows x"]) -> Float[np.ndarray, "rows x"]:
        """Standard inputs, single precision."""
        return ((given - self.given_mean) / self.given_sd).astype(np.float32)

    def standard(self, data: Transitions) -> tuple[Float[np.ndarray, "rows x"], Float[np.ndarray, "rows y"]]:
        """Inputs and what is left of changes in standard units, single precision."""
        left = data.change - self.linear(data.given)
        return self.inputs(data.given), (left / self.change_sd).astype(np.float32)

    def linear(self, given: Float[np.ndarray, "rows x"]) -> Float[np.ndarray, "rows y"]:
        """The changes' linear part."""
        return _with_one((given - self.given_mean) / self.given_sd) @ self.gain

    @property
    def log_volume(self) -> float:
        """log of the factor by which densities of changes in standard units exceed those in their own."""
        return float(np.log(self.change_sd).sum())


def _with_one(x: Float[np.ndarray, "rows x"]) -> Float[np.ndarray, "rows inputs"]:
    return np.concatenate([x, np.ones((len(x), 1))], 1)
