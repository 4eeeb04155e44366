"""Coordinates x in which the posterior about a fit is roughly standard normal, with the volume of the map to z."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import scale_of
from det2stoc_bayes.newton import most_probable
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.populations import better_spreads, log_spread_sd
from det2stoc_bayes.unknowns import Unknowns

WIDEST = 12.0  # |log sigma| steps beyond it overflow
STEP = 1e-4  # relative: finite difference of a prior's quantile


@runtime_checkable
class Coordinates(Protocol):
    """A one-to-one map x -> z."""

    @property
    def size(self) -> int:
        """Of x and of z."""
        ...

    @property
    def spreads(self) -> int:
        """How many coordinates, the first ones, are spreads of a psi by recording: given them the rest is Gaussian."""
        ...

    def __call__(
        self, x: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points size"], Float[np.ndarray, " points"]]:
        """z, and log |dz / dx|."""
        ...


class Affine:
    """Laplace's approximation, the likelihood tempered: z = center + scale x."""

    def __init__(self, fit: Fit, temper: float):
        gram, slope, _ = (v.sum(0) * temper for v in fit.linear.gram())
        self._center = most_probable(fit.problem, fit.point.z, gram, slope)
        self._scale = scale_of(gram + np.eye(fit.problem.size))

    @property
    def size(self) -> int:
        """Of x and of z."""
        return len(self._center)

    @property
    def spreads(self) -> int:
        """None."""
        return 0

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z, and log |dz / dx|."""
        return self._center + x @ self._scale.T, np.full(len(x), np.log(np.diag(self._scale)).sum())


class Population:
    """Where psi varies by recording: log sigma, then all other unknowns given it.

    Linearized about a fit that holds sigma; z has sigma among the unknowns. Without this shear the posterior is a
    funnel that no Gaussian covers.
    """

    def __init__(self, held: Fit, freed: Unknowns, temper: float):
        tempered = replace(held, noise_scale=1.0 / temper)
        better, spreads = better_spreads(tempered), np.array(held.problem.spreads)
        self._held, self._freed = held.problem.unknowns, freed
        self._center = np.log((spreads if better is None else np.array(better)) / spreads)
        self._sd = log_spread_sd(tempered)
        gram, slope, _ = (v.sum(0) * temper for v in held.linear.gram())
        self._gram, self._pull = gram, slope + gram @ held.point.z

    @property
    def size(self) -> int:
        """Of x and of z."""
        return len(self._sd) + len(self._pull)

    @property
    def spreads(self) -> int:
        """One a psi that varies."""
        return len(self._sd)

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z, and log |dz / dx|."""
        count = len(self._sd)
        factor = np.clip(self._center + self._sd * x[:, :count], -WIDEST, WIDEST)  # log sigma / held sigma
        held, log_det = self._given(factor, x[:, count:])
        z, volume = self._with_sigma(held, factor)
        return z, log_det + volume + np.log(self._sd).sum()

    def _given(self, factor: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The other unknowns in the held layout, from standard normals u, given log factors of sigma."""
        z, log_det = np.empty_like(u), np.empty(len(u))
        for i, (f, own) in enumerate(zip(factor, u, strict=True)):
            inverse = np.ones(u.shape[1])
            for rows, one in zip(self._held.own, f, strict=True):
                inverse[rows] = np.exp(-2 * one)
            precision = self._gram + np.diag(inverse)
            root = scale_of(precision)
            z[i] = root @ (root.T @ self._pull) + root @ own
            log_det[i] = np.log(np.diag(root)).sum()
        return z, log_det

    def _with_sigma(self, held: np.ndarray, factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The layout that has sigma, where a recording's own unknown counts in sigmas; and the volume of the change."""
        z = np.empty((len(held), self._freed.size + held.shape[1] - self._held.size))
        z[:, self._freed.size :] = held[:, self._held.size :]
        volume, k = np.zeros(len(held)), 0
        for old, new in zip(self._held.blocks, self._freed.blocks, strict=True):
            z[:, new.begin] = held[:, old.begin]
            if not old.varies:
                continue
            f, k = factor[:, k], k + 1
            sigma = float(old.spread or 0.0) * np.exp(f)
            low, here, high = (new.sigma_prior.to_normal(sigma * s) for s in (1 - STEP, 1.0, 1 + STEP))
            z[:, new.begin + 1] = here
            z[:, new.first_own : new.stop] = held[:, old.first_own : old.stop] * np.exp(-f)[:, None]
            volume += np.log((high - low) / (2 * STEP)) - new.recordings * f
        return z, volume
