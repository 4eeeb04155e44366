"""A learned stochastic simulator as a Gymnasium environment, to train a policy in."""

from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.inference._stochastic import StochasticSimulator, rows_of

Reward = Callable[[np.ndarray, np.ndarray, np.ndarray], float]  # state, action, next state


def _nothing(state: np.ndarray, action: np.ndarray, after: np.ndarray) -> float:
    return 0.0


class StochasticEnv(gymnasium.Env):
    """Episodes of `num_steps` from one of the starts; each has a latent of its own, as it would have its own psi."""

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self,
        simulator: StochasticSimulator,
        starts: Float[np.ndarray, "starts s"],
        action_low: Float[np.ndarray, " a"],
        action_high: Float[np.ndarray, " a"],
        num_steps: int,
        reward: Reward = _nothing,
    ):
        """Raises Det2StocError where the simulator cannot take such starts or actions, or there is no step."""
        low, high = rows_of("action_low, action_high", [action_low, action_high], simulator.num_actions)
        if not (low <= high).all():
            raise Det2StocError(f"action_low, action_high: found {low} and {high}; allowed: low at most high")
        self.simulator, self.starts = simulator, rows_of("starts", starts, simulator.num_states)
        if not (len(self.starts) and np.isfinite(self.starts).all() and num_steps > 0):
            found = f"{len(self.starts)} starts and {num_steps} steps"
            raise Det2StocError(f"starts, num_steps: found {found}; allowed: one at least of either, all finite")
        self.num_steps, self.reward = num_steps, reward
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        size = (self.starts.shape[1],)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, size, dtype=np.float64)
        self._state, self._done, self._z = self.starts[0], 0, None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """A start and a latent, both drawn."""
        super().reset(seed=seed, options=options)
        self._state = self.starts[self.np_random.integers(len(self.starts))].copy()
        self._z, self._done = self.simulator.latents(self._key(), 1), 0
        return self._state.copy(), {}

    def step(self, action: Float[np.ndarray, " a"]) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One transition; the episode is truncated after `num_steps`."""
        if self._z is None:
            raise gymnasium.error.ResetNeeded("step: the environment was not reset; allowed: reset() first")
        before, action = self._state, np.asarray(action, float)
        self._state = self.simulator.sample(self._key(), before[None], action[None], self._z)[0]
        self._done += 1
        told = float(self.reward(before, action, self._state))
        return self._state.copy(), told, False, self._done >= self.num_steps, {}

    def _key(self) -> jax.Array:
        return jax.random.key(int(self.np_random.integers(2**63)))
