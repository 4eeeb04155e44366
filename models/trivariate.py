"""A random Gaussian over (s', s, a), whose conditional p(s' | s, a) is known: the thesis' analytic check.

As a problem of inference: s' under its marginal is the prior, a pair (s, a) under p(s, a | s') is what is observed, so
that the posterior is that conditional. There are as many pairs as the thesis' figure has conditions.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.priors import Prior
from det2stoc_bayes.vector_problem import Posed, VectorProblem

JITTER = 0.03
NUM_PAIRS = 3
SEED = 1  # of the Gaussian, and of the pairs that are observed


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


class Conditional(VectorProblem):
    """s' of NUM_PAIRS pairs (s, a) of one Gaussian."""

    name: ClassVar = "trivariate"
    recordings = tuple(f"pair_{k + 1}" for k in range(NUM_PAIRS))

    @cached_property
    def gaussian(self) -> Trivariate:
        """Of (s', s, a)."""
        return draw(np.random.default_rng(SEED))

    @cached_property
    def priors(self) -> tuple[Prior, ...]:
        """The marginal of s', once a pair."""
        loc, scale = float(self.gaussian.mean[0]), float(np.sqrt(self.gaussian.covariance[0, 0]))
        return (Prior("Normal", {"loc": loc, "scale": scale}),) * NUM_PAIRS

    @property
    def names(self) -> tuple[str, ...]:
        """s' of each pair."""
        return tuple(f"next_{k + 1}" for k in range(NUM_PAIRS))

    @cached_property
    def observed(self) -> Float[np.ndarray, " features"]:
        """s and a of the pairs, one after the other."""
        return self.gaussian.sample(np.random.default_rng([SEED, 1]), NUM_PAIRS)[:, 1:].ravel()

    def simulate(self, theta: Float[np.ndarray, "sims 3"], random: np.random.Generator) -> Float[np.ndarray, "sims 6"]:
        """Pairs under each s'."""
        mean, covariance = self._given(theta)
        noise = random.standard_normal(mean.shape) @ np.linalg.cholesky(covariance).T
        return (mean + noise).reshape(len(theta), -1)

    def by_recording(
        self, theta: Float[np.ndarray, "points 3"], x: Float[np.ndarray, " 6"]
    ) -> Float[np.ndarray, "points 3"]:
        """log p(s, a | s') of each pair."""
        mean, covariance = self._given(theta)
        off = x.reshape(NUM_PAIRS, 2) - mean
        square = np.einsum("pki,ij,pkj->pk", off, np.linalg.inv(covariance), off)
        return -0.5 * square - 0.5 * float(np.linalg.slogdet(2 * np.pi * covariance)[1])

    def log_likelihood(
        self, theta: Float[np.ndarray, "points 3"], x: Float[np.ndarray, " 6"]
    ) -> Float[np.ndarray, " points"]:
        """Their sum."""
        return self.by_recording(theta, x).sum(1)

    def _given(
        self, after: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points 3 2"], Float[np.ndarray, "2 2"]]:
        """Mean and covariance of (s, a) at each s'."""
        of, mean = self.gaussian.covariance, self.gaussian.mean
        gain = of[1:, 0] / of[0, 0]
        return mean[1:] + (after - mean[0])[..., None] * gain, of[1:, 1:] - np.outer(gain, of[0, 1:])


PROBLEM = Conditional()


def closed_form(problem: Posed) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Mean and covariance of the unknowns, which are s' in units of its marginal."""
    gaussian = PROBLEM.gaussian
    mean, variance = gaussian.conditional(problem.x.reshape(-1, 2))
    whole = gaussian.covariance[0, 0]
    return (mean - gaussian.mean[0]) / np.sqrt(whole), variance / whole * np.eye(len(mean))
