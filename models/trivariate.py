"""A random Gaussian over (s', s, a), whose conditional p(s' | s, a) is known: the thesis' analytic check."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

JITTER = 0.03


@dataclass(frozen=True, eq=False)
class Trivariate:
    """Mean and covariance of (s', s, a)."""

    mean: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "3 3"]

    def sample(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "count 3"]:
        """Draws of (s', s, a)."""
        return self.mean + random.standard_normal((count, 3)) @ np.linalg.cholesky(self.covariance).T

    def conditional(self, given: Float[np.ndarray, "points 2"]) -> tuple[Float[np.ndarray, " points"], float]:
        """Mean at each (s, a), and the variance, which is one."""
        gain = np.linalg.solve(self.covariance[1:, 1:], self.covariance[1:, 0])
        return self.mean[0] + (given - self.mean[1:]) @ gain, float(
            self.covariance[0, 0] - gain @ self.covariance[1:, 0]
        )


def draw(random: np.random.Generator) -> Trivariate:
    """Mean U(-3, 3), covariance A A' + 0.03 I with A of U(0, 1)."""
    mean, a = random.uniform(-3, 3, 3), random.uniform(0, 1, (3, 3))
    return Trivariate(mean, a @ a.T + JITTER * np.eye(3))
