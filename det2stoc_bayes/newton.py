"""A Gauss-Newton step: to the most probable point, were predictions linear in the straightened unknowns."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from det2stoc_bayes.linearization import Linearization
from det2stoc_bayes.problem import FARTHEST, Problem

LARGEST_STEP = 10.0  # prior sds of an effect in one iteration


@dataclass(frozen=True)
class Step:
    """A change of the unknowns and what it promises."""

    z: Float[np.ndarray, " size"]
    gain: float  # expected, nats
    s2: float


def newton_step(lin: Linearization, free_scale: bool) -> Step:
    """The most probable point were predictions linear in psi: its bend in z, near a prior's bound, is exact."""
    gram, slope, square = (x.sum(0) for x in lin.gram())
    s2 = noise_scale(lin, float(square), free_scale)
    r = lin.latent.project(lin.stacked)
    free = float((lin.stacked**2).sum() - (r**2).sum())
    z = most_probable(lin.problem, lin.point.z, gram / s2, slope / s2)
    moved = z - lin.point.z
    bent = lin.problem.straightened(z, lin.point.z)
    gain = bent @ slope / s2 - 0.5 * bent @ gram @ bent / s2 - 0.5 * (z @ z - lin.point.z @ lin.point.z)
    return Step(moved, max(float(gain), 0.0) + 0.5 * free / s2, s2)


def most_probable(
    problem: Problem,
    z: Float[np.ndarray, " size"],
    gram: Float[np.ndarray, "size size"],
    slope: Float[np.ndarray, " size"],
) -> Float[np.ndarray, " size"]:
    """Maximum of the prior times a likelihood that is Gaussian in `straightened` unknowns, within LARGEST_STEP of z."""
    if not problem.size:
        return z
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))  # unknowns near a bound count little, but must be seen
    values, vectors = np.linalg.eigh(gram / np.outer(size, size))
    keep = values > 1e-13 * max(values[-1], 1e-300)
    root = np.sqrt(values[keep])[:, None] * vectors[:, keep].T * size
    target = (vectors[:, keep].T @ (slope / size)) / np.sqrt(values[keep])

    straight = problem.straightener(z)

    def misfit(x):
        return np.concatenate([root @ straight(x) - target, x])

    # A psi may go anywhere in its prior, whose bend is exact, short of where quantiles lose their digits.
    psi = np.arange(problem.size) < problem.num_psi
    low = np.where(psi, np.minimum(-FARTHEST, z), np.maximum(z - LARGEST_STEP, problem.floor))
    high = np.where(psi, np.maximum(FARTHEST, z), np.maximum(z, low) + LARGEST_STEP)
    return least_squares(misfit, np.maximum(z, low), bounds=(low - 1e-9, high + 1e-9), xtol=1e-10, ftol=1e-12).x


def noise_scale(lin: Linearization, chi2: float, free_scale: bool) -> float:
    """Variance ratio by which the misfit exceeds the noise, at least 1."""
    dof = max(lin.degrees_of_freedom - lin.problem.size, 1)
    return max(1.0, chi2 / lin.problem.measurement.mean_square / dof) if free_scale else 1.0
