"""The density of a posed problem of vectors, with what methods ask of a study's `Density` and of its mode."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import STEP, Density, log_prior, scale_of
from det2stoc_bayes.errors import SamplingFailed
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.vector_problem import Posed

type Inferred = Problem | Posed  # what a method infers from
type AnyDensity = Density | VectorDensity

FIRST = 0.01  # prior sds: the scale that the search for the mode begins with
MOST_STEPS = 100  # of Newton's method
ENOUGH = 1e-6  # nats that another one may gain
FLATTEST = 0.1  # of the prior's curvature: the density is taken for no flatter than that along any axis
FRACTIONS = np.array([1.0, 0.5, 0.2, 0.05, 0.01, 0.002, 0.0])
MOST_POINTS = 250  # at a time: their arrays stay in a cache


@dataclass(frozen=True, eq=False)
class VectorDensity:
    """Prior N(0, I) and terms by recording, in the coordinates w that samplers move in.

    A term holds, besides the recording's log likelihood, what the prior of z(w) has more than N(w; 0, I). `natural`:
    w is z itself.
    """

    problem: Posed
    center: Float[np.ndarray, " size"]
    scale: Float[np.ndarray, "size size"]  # lower triangular; w = center + scale u makes u about standard normal
    natural: bool = False

    @classmethod
    def of_prior(cls, problem: Posed) -> "VectorDensity":
        """In z, about the prior."""
        problem.counter.simulations += problem.problem.num_simulated
        return cls(problem, np.zeros(problem.size), np.eye(problem.size), natural=True)

    @property
    def density(self) -> "VectorDensity":
        """Itself: it is at its own mode."""
        return self

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.problem.size

    def log_likelihood_by_recording(
        self, w: Float[np.ndarray, "points size"]
    ) -> Float[np.ndarray, "points recordings"]:
        """The terms."""
        vectors, x = self.problem.problem, self.problem.x
        out = [np.empty((0, len(self.problem.recordings)))]
        for begin in range(0, len(w), MOST_POINTS):
            rows = np.asarray(w[begin : begin + MOST_POINTS], float)
            theta = vectors.constrained(rows) if self.natural else vectors.placed(rows)
            out.append(vectors.by_recording(theta, x) + (0.0 if self.natural else vectors.volume(theta)))
        terms = np.concatenate(out)
        return np.where(np.isfinite(terms), terms, -np.inf)

    def log_likelihood(self, w: Float[np.ndarray, "points size"]) -> Float[np.ndarray, " points"]:
        """Sum of the terms."""
        return self.log_likelihood_by_recording(w).sum(1)

    def log_density(self, w: Float[np.ndarray, "points size"]) -> Float[np.ndarray, " points"]:
        """log of the joint density in w."""
        return self.log_likelihood(w) + log_prior(np.asarray(w, float))

    def told(
        self, w: Float[np.ndarray, "chain draw size"], terms: Float[np.ndarray, "chain draw recordings"]
    ) -> tuple[Float[np.ndarray, "chain draw size"], Float[np.ndarray, "chain draw recordings"]]:
        """Draws as z, and their log likelihood alone."""
        if self.natural:
            return w, terms
        flat, vectors = w.reshape(-1, self.size), self.problem.problem
        return vectors.outward(flat).reshape(w.shape), terms - vectors.volume(vectors.placed(flat)).reshape(terms.shape)

    def terms_and_grad(
        self, z: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points recordings"], Float[np.ndarray, "points size"]]:
        """The terms, and their sum's gradient by central differences."""
        steps = np.concatenate([np.zeros((1, self.size)), self._steps, -self._steps])
        terms = self.log_likelihood_by_recording((z[:, None] + steps).reshape(-1, self.size))
        here, above, below = np.split(terms.reshape(len(z), len(steps), -1), [1, 1 + len(self._steps)], 1)
        with np.errstate(invalid="ignore"):  # where the density is 0 there is no force
            change = np.nan_to_num((above - below) / 2, nan=0.0, posinf=0.0, neginf=0.0)
        gradient = np.empty(z.shape)
        for k, moved in enumerate(self.problem.problem.probes()):
            alone = len(moved) == 1
            gradient[:, moved] = (change[:, k].sum(1, keepdims=True) if alone else change[:, k]) / self._steps[k, moved]
        self.problem.counter.gradients += len(z)
        return here[:, 0], gradient

    @cached_property
    def _steps(self) -> Float[np.ndarray, "probes size"]:
        sd = STEP * np.sqrt((self.scale**2).sum(1))
        every = np.arange(self.size)
        return np.stack([np.where(np.isin(every, moved), sd, 0.0) for moved in self.problem.problem.probes()])

    def _curvature(self) -> tuple[Float[np.ndarray, " size"], Float[np.ndarray, "size size"]]:
        """Gradient of the log density at the center, and minus its second derivatives."""
        step = np.diag(STEP * np.sqrt((self.scale**2).sum(1)))
        points = np.concatenate([self.center[None], self.center + step, self.center - step])
        slope = self.terms_and_grad(points)[1] - points
        second = -(slope[1 : 1 + self.size] - slope[1 + self.size :]) / (2 * np.diag(step)[:, None])
        return slope[0], (second + second.T) / 2


def find_peak(problem: Posed) -> VectorDensity:
    """The density at its maximum, by Newton's method; SamplingFailed where none is reached."""
    problem.counter.simulations += problem.problem.num_simulated
    first = problem.problem.first_guess(problem.x)
    density = VectorDensity(problem, first, FIRST * np.eye(problem.size))
    for better, gain in _climbing(density):
        density = better
        if gain < ENOUGH:
            return density
    raise SamplingFailed(f"{problem.name}: no maximum of the density within {MOST_STEPS} steps; allowed: a smooth one")


def _climbing(density: VectorDensity) -> Iterator[tuple[VectorDensity, float]]:
    """Densities about better and better centers, with what each step gained."""
    height = float(density.log_density(density.center[None])[0])
    for _ in range(MOST_STEPS):
        gradient, precision = density._curvature()
        size, axes = np.linalg.eigh(precision)
        precision = (axes * np.maximum(np.abs(size), FLATTEST)) @ axes.T
        tried = density.center + FRACTIONS[:, None] * np.linalg.solve(precision, gradient)
        heights = density.log_density(tried)
        best = int(np.argmax(heights))
        density = replace(density, center=tried[best], scale=scale_of(precision))
        gain, height = float(heights[best]) - height, float(heights[best])
        yield density, gain
