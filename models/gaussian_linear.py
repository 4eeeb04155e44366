"""The mean of a Gaussian in ten dimensions, as the SBI benchmark defines it (Lueckmann et al. 2021, T.1)."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.priors import Prior
from det2stoc_bayes.vector_problem import VectorProblem

SIZE, VARIANCE = 10, 0.1  # of the prior, and of x about theta


class GaussianLinear(VectorProblem):
    """x ~ N(theta, 0.1 I), theta ~ N(0, 0.1 I)."""

    name: ClassVar = "gaussian_linear"
    priors: ClassVar = (Prior("Normal", {"loc": 0.0, "scale": float(np.sqrt(VARIANCE))}),) * SIZE

    def simulate(
        self, theta: Float[np.ndarray, "sims 10"], random: np.random.Generator
    ) -> Float[np.ndarray, "sims 10"]:
        """One x for each theta."""
        return theta + np.sqrt(VARIANCE) * random.standard_normal(theta.shape)

    def log_likelihood(
        self, theta: Float[np.ndarray, "points 10"], x: Float[np.ndarray, " 10"]
    ) -> Float[np.ndarray, " points"]:
        """log N(x; theta, 0.1 I)."""
        return -0.5 * ((x - theta) ** 2 / VARIANCE + np.log(2 * np.pi * VARIANCE)).sum(1)

    def exact_posterior(self, x: Float[np.ndarray, " 10"]) -> tuple[Float[np.ndarray, " 10"], float]:
        """Mean, and the sd of every component: prior and likelihood are equally wide."""
        return x / 2, float(np.sqrt(VARIANCE / 2))


PROBLEM = GaussianLinear()
