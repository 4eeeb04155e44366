"""The most probable unknowns, and how the predictions bend about them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import Density, scale_of
from det2stoc_bayes.errors import MethodNotApplicable, SimulationDiverged
from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.segments import cut
from det2stoc_bayes.start_fit import searched_again

HORIZONS = (25, 250)  # samples: long rollouts have many optima, short ones one
BEND = 0.3  # of a posterior sd: finite difference of second derivatives
MAX_CURVATURE = 40_000_000  # numbers in the second derivatives
ENOUGH = 1e-4  # nats that another Newton step may gain


def find_map(problem: Problem, *, max_iterations: int = 20) -> Fit:
    """The MAP at the declared noise, led there by short segments with a widened noise first."""
    if problem.size == 0:
        raise MethodNotApplicable(
            f"{problem.simulator.study.folder}: study.toml declares no psi, so that nothing is unknown; "
            "allowed: one [psi.NAME] at least"
        )
    segments, shorter = problem.segments, None
    for horizon in HORIZONS:
        if 2 * horizon > segments.time.shape[1]:
            continue
        short = problem.on(cut(segments.recordings, horizon, segments.columns))
        begin = start_point(short, shorter and shorter.point.z, shorter)
        fit = fit_many([(short, begin)], max_iterations=max_iterations)[0]
        shorter = shorter if fit is None else fit.linear
    point = start_point(problem, shorter and shorter.point.z, shorter)
    for free_scale in (True, False):
        fit = fit_many([(problem, point)], max_iterations=max_iterations, free_scale=free_scale)[0]
        if fit is None:
            raise SimulationDiverged("no simulation of the believed model stays finite over the recordings")
        fit = searched_again(fit, max_iterations=max_iterations) if free_scale else fit
        point = fit.point
    return fit


@dataclass(frozen=True, eq=False)
class Expansion:
    """Predictions to second order in u about a point z = center + scale u, through a density's projection."""

    density: Density
    center: Float[np.ndarray, " size"]
    scale: Float[np.ndarray, "size size"]
    value: Float[np.ndarray, " stacked"]  # projected whitened residual at the center
    slope: Float[np.ndarray, "stacked size"]
    curvature: Float[np.ndarray, "stacked size*size"]

    @property
    def gradient(self) -> Float[np.ndarray, " size"]:
        """Of the log density in u, at the center."""
        return -self.slope.T @ self.value - self.scale.T @ self.center

    @property
    def precision(self) -> Float[np.ndarray, "size size"]:
        """Of u: exact second derivatives, or Gauss-Newton's where those have no maximum."""
        size = self.density.size
        first = self.slope.T @ self.slope + self.scale.T @ self.scale
        exact = first + (self.value @ self.curvature).reshape(size, size)
        low, high = np.linalg.eigvalsh(exact)[[0, -1]]
        return exact if low > 1e-6 * high else first

    def terms_and_grad(
        self, z: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points recordings"], Float[np.ndarray, "points size"]]:
        """Exact log likelihood by recording; its gradient by this expansion's sensitivities.

        One simulation a point. Leapfrog steps with any force leave volumes alone, so that HMC that accepts by
        exact values samples exactly.
        """
        density, size = self.density, self.density.size
        z, beyond = density.walled(z)
        projected = density.projected(z)
        terms = density.by_recording(density.terms(projected))
        terms[beyond] = -np.inf
        r = np.nan_to_num(projected, nan=0.0).reshape(-1, len(z))
        u = np.linalg.solve(self.scale, (z - self.center).T)
        bent = (r.T @ self.curvature).reshape(len(z), size, size) @ u.T[..., None]
        slope = (self.slope.T @ r).T + bent[..., 0]
        density.problem.simulator.counter.gradients += len(z)
        return terms, np.linalg.solve(self.scale.T, -slope.T).T


def expand(density: Density, center: Float[np.ndarray, " size"], scale: Float[np.ndarray, "size size"]) -> Expansion:
    """By central differences in batches; curvature is left out (0) where it would not fit in memory."""
    size, axes = density.size, np.eye(density.size)
    bends = density.latent.basis[..., 0].size * size**2 <= MAX_CURVATURE
    pairs = [(i, j) for i in range(size) for j in range(i)] if bends else []
    offsets = [np.zeros(size), *axes, *-axes, *(axes[i] + axes[j] for i, j in pairs)]
    z = center + BEND * np.stack(offsets) @ scale.T
    p = np.concatenate(
        [density.projected(z[rows]).reshape(-1, rows.stop - rows.start) for rows in density.chunks(len(z))], 1
    )
    if not np.isfinite(p[:, 0]).all():
        raise SimulationDiverged("a simulation at the most probable parameters does not stay finite")
    value, above, below, mixed = np.split(p, [1, 1 + size, 1 + 2 * size], axis=1)
    slope = np.nan_to_num((above - below) / (2 * BEND), nan=0.0)
    if not bends:
        return Expansion(density, center, scale, value[:, 0], slope, np.broadcast_to(0.0, (len(p), size**2)))
    curvature = np.empty((len(p), size, size))
    curvature[:, range(size), range(size)] = above - 2 * value + below
    for (i, j), both in zip(pairs, mixed.T, strict=True):
        curvature[:, i, j] = curvature[:, j, i] = both - above[:, i] - above[:, j] + value[:, 0]
    curvature = np.nan_to_num(curvature.reshape(len(p), -1) / BEND**2, nan=0.0)
    return Expansion(density, center, scale, value[:, 0], slope, curvature)


def find_mode(density: Density, *, max_iterations: int = 6) -> Expansion:
    """The maximum of a density by Newton's method, expanded there: u is about standard normal."""
    expansion = expand(density, density.center, density.scale)
    for _ in range(max_iterations):
        precision, gradient = expansion.precision, expansion.gradient
        step = np.linalg.solve(precision, gradient)
        scale = _lower(expansion.scale @ scale_of(precision))
        fractions = np.array([0.0, 1.0, 0.5, 0.2, 0.05])
        tried = expansion.center + fractions[:, None] * (expansion.scale @ step)
        best = int(np.argmax(density.log_density(tried)))
        expansion = expand(density, tried[best], scale)
        if 0.5 * gradient @ step < ENOUGH or best == 0:
            break
    return expansion


def _lower(root: Float[np.ndarray, "size size"]) -> Float[np.ndarray, "size size"]:
    triangle = np.linalg.qr(root.T, mode="r").T
    return triangle * np.sign(np.diagonal(triangle))
