"""Problems that are no studies: a prior, a simulator of vectors, and a likelihood in closed form.

As in a study every unknown is a standard normal z, and theta follows by the priors' quantiles. A problem that has an
observation of its own (`observed`) is what methods are compared on, as a `Posed` one.
"""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.engines.base import Counter
from det2stoc_bayes.errors import EngineError
from det2stoc_bayes.priors import Prior
from det2stoc_bayes.unknowns import Unknowns


class VectorProblem(ABC):
    """One theta in, one vector x out; arrays of many."""

    name: ClassVar[str]
    priors: ClassVar[tuple[Prior, ...]]  # of theta's components, independent
    recordings: tuple[str, ...] = ("x",)  # parts of x that are independent given theta
    unknowns = Unknowns((), ())  # which components are one parameter of several recordings
    num_simulated = 0  # simulations that the likelihood itself is made of

    @property
    def observed(self) -> Float[np.ndarray, " features"] | None:
        """The problem's own x, if it has one."""
        return None

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

    def by_recording(
        self, theta: Float[np.ndarray, "points size"], x: Float[np.ndarray, " features"]
    ) -> Float[np.ndarray, "points recordings"]:
        """Its terms, one a recording."""
        return self.log_likelihood(theta, x)[:, None]

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

    def prepare(self) -> None:  # noqa: B027  most need nothing
        """Do once what all inference needs; what is sent to other processes then has it."""

    @property
    def settings(self) -> tuple[object, ...]:
        """What a likelihood that is no formula follows from."""
        return ()

    def placed(self, w: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points size"]:
        """theta at the coordinates w that samplers move in: z's, unless others suit the posterior better."""
        return self.constrained(self.outward(w))

    def outward(self, w: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points size"]:
        """z at w."""
        return w

    def volume(self, theta: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points recordings"]:
        """log of dz/dw N(z; 0, I) / N(w; 0, I) where theta is, one term a recording."""
        return np.zeros((len(theta), len(self.recordings)))

    def first_guess(self, x: Float[np.ndarray, " features"]) -> Float[np.ndarray, " size"]:
        """w from which the most probable one is looked for."""
        return np.zeros(self.size)

    def probes(self) -> Sequence[Int[np.ndarray, " moved"]]:
        """Unknowns that may move at once for a gradient: of several each moves the term of its own recording alone."""
        return [np.array([j]) for j in range(self.size)]

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


@dataclass(frozen=True, eq=False)
class Posed:
    """A problem of vectors with what was observed: what methods infer from, in the place of a study's `Problem`."""

    problem: VectorProblem
    x: Float[np.ndarray, " features"]
    counter: Counter = field(default_factory=Counter)
    engine: str = "c"

    def __post_init__(self) -> None:
        if self.engine != "c":
            raise EngineError(f"engine: found {self.engine}; allowed: c, which {self.name} is simulated by if at all")

    @property
    def name(self) -> str:
        """The problem's."""
        return self.problem.name

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.problem.size

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns."""
        return self.problem.names

    @property
    def recordings(self) -> tuple[str, ...]:
        """Names of the independent parts of x."""
        return self.problem.recordings

    @property
    def unknowns(self) -> Unknowns:
        """Which unknowns are one parameter of several recordings."""
        return self.problem.unknowns

    @property
    def fingerprint(self) -> str:
        """Equal where a method's results would be: of what a problem is known by, and of x."""
        known = repr((self.name, self.problem.settings)).encode()
        return hashlib.sha256(known + np.ascontiguousarray(self.x).tobytes()).hexdigest()

    def constrained(self, z: Any, xp: Any = np) -> dict[str, Any]:
        """Every unknown by name in its own unit, for arrays (..., size)."""
        theta = self.problem.constrained(np.asarray(z, float).reshape(-1, self.size)).reshape(np.shape(z))
        return dict(zip(self.names, np.moveaxis(theta, -1, 0), strict=True))
