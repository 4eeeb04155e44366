"""Simple likelihood, complex posterior (Papamakarios et al. 2019), as the SBI benchmark defines it (T.3)."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.priors import Prior
from det2stoc_bayes.vector_problem import VectorProblem

NUM_POINTS = 4
LEAST_VARIANCE = 1e-6  # added to each axis'


class Slcp(VectorProblem):
    """Four points of a Gaussian in the plane: means theta1, theta2, sds theta3^2, theta4^2, correlation tanh theta5."""

    name: ClassVar = "slcp"
    priors: ClassVar = (Prior("Uniform", {"low": -3.0, "high": 3.0}),) * 5

    def simulate(self, theta: Float[np.ndarray, "sims 5"], random: np.random.Generator) -> Float[np.ndarray, "sims 8"]:
        """The points' coordinates, one after the other."""
        first, covariance, second = _covariance(theta)
        root = np.sqrt(first)
        e, f = random.standard_normal((2, NUM_POINTS, len(theta)))
        a = theta[:, 0] + root * e
        b = theta[:, 1] + covariance / root * e + np.sqrt(second - covariance**2 / first) * f
        return np.stack([a, b], -1).transpose(1, 0, 2).reshape(len(theta), -1)

    def log_likelihood(
        self, theta: Float[np.ndarray, "points 5"], x: Float[np.ndarray, " 8"]
    ) -> Float[np.ndarray, " points"]:
        """Sum over the points of the Gaussian's log density."""
        first, covariance, second = _covariance(theta)
        determinant = first * second - covariance**2
        u, v = np.moveaxis(x.reshape(NUM_POINTS, 1, 2) - theta[:, :2], -1, 0)
        square = (second * u**2 - 2 * covariance * u * v + first * v**2) / determinant
        return -0.5 * (square.sum(0) + NUM_POINTS * np.log(4 * np.pi**2 * determinant))


PROBLEM = Slcp()


def _covariance(theta: Float[np.ndarray, "points 5"]) -> tuple[Float[np.ndarray, " points"], ...]:
    """Variance along the first axis, covariance, variance along the second."""
    first, second, correlation = theta[:, 2] ** 2, theta[:, 3] ** 2, np.tanh(theta[:, 4])
    return first**2 + LEAST_VARIANCE, correlation * first * second, second**2 + LEAST_VARIANCE
