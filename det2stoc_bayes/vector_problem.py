"""Problems that are no studies: a prior, a simulator of vectors, and a likelihood in closed form.

As in a study every unknown is a standard normal z, and theta follows by the priors' quantiles.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.priors import Prior


class VectorProblem(ABC):
    """One theta in, one vector x out; arrays of many."""

    name: ClassVar[str]
    priors: ClassVar[tuple[Prior, ...]]  # of theta's components, independent

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.priors)

    @abstractmethod
    def simulate(
        self, theta: Float[np.ndarray, "sims size"], random: np.random.Generator
    ) -> Float[np.ndarray, "sims features"]:
        """One x for each theta."""

    @abstractmethod
    def log_likelihood(
        self, theta: Float[np.ndarray, "points size"], x: Float[np.ndarray, " features"]
    ) -> Float[np.ndarray, " points"]:
        """log p(x | theta)."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns."""
        return tuple(f"theta_{k + 1}" for k in range(self.size))

    def constrained(self, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points size"]:
        """theta from standard normals."""
        return np.stack([p.from_normal(column) for p, column in zip(self.priors, z.T, strict=True)], 1)

    def unconstrained(self, theta: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points size"]:
        """The inverse of `constrained`."""
        return np.stack([p.to_normal(column) for p, column in zip(self.priors, theta.T, strict=True)], 1)

    def draw(
        self, count: int, random: np.random.Generator
    ) -> tuple[Float[np.ndarray, "count size"], Float[np.ndarray, "count features"]]:
        """z of the prior, and an x for each."""
        z = random.standard_normal((count, self.size))
        return z, self.simulate(self.constrained(z), random)

    def replicate(self, random: np.random.Generator) -> tuple[Float[np.ndarray, " features"], dict[str, float]]:
        """One x, and the z behind it by name."""
        z, x = self.draw(1, random)
        return x[0], dict(zip(self.names, z[0].tolist(), strict=True))

    def log_density(
        self, z: Float[np.ndarray, "points size"], x: Float[np.ndarray, " features"]
    ) -> Float[np.ndarray, " points"]:
        """log p(x | z) + log N(z; 0, I), what exact samplers take."""
        return self.log_likelihood(self.constrained(z), x) + log_prior(z)
