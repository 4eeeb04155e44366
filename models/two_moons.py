"""Two crescents (Greenberg et al. 2019), as the SBI benchmark defines them (Lueckmann et al. 2021, T.8)."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.priors import Prior
from det2stoc_bayes.vector_problem import VectorProblem

RADIUS, THICKNESS, OFFSET = 0.1, 0.01, 0.25


class TwoMoons(VectorProblem):
    """x = a point on a blurred half circle, moved by (-|theta1 + theta2|, -theta1 + theta2) / sqrt(2)."""

    name: ClassVar = "two_moons"
    priors: ClassVar = (Prior("Uniform", {"low": -1.0, "high": 1.0}),) * 2

    def simulate(self, theta: Float[np.ndarray, "sims 2"], random: np.random.Generator) -> Float[np.ndarray, "sims 2"]:
        """One x for each theta."""
        angle = random.uniform(-np.pi / 2, np.pi / 2, len(theta))
        radius = random.normal(RADIUS, THICKNESS, len(theta))
        return np.stack([radius * np.cos(angle) + OFFSET, radius * np.sin(angle)], 1) + _moved(theta)

    def log_likelihood(
        self, theta: Float[np.ndarray, "points 2"], x: Float[np.ndarray, " 2"]
    ) -> Float[np.ndarray, " points"]:
        """The benchmark's, which lacks a constant and the polar coordinates' 1 / r (and radii below 0)."""
        u, v = (x - _moved(theta)).T
        u = u - OFFSET
        off = (np.hypot(u, v) - RADIUS) / THICKNESS
        return np.where(u < 0, -np.inf, -0.5 * off**2 - 0.5 * np.log(2 * np.pi * THICKNESS**2))


PROBLEM = TwoMoons()


def _moved(theta: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
    first, second = theta.T
    return np.stack([-np.abs(first + second), second - first], 1) / np.sqrt(2)
