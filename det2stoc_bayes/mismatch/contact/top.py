"""The top of a likelihood that contact makes rough: a quadratic through many points about a fit, not its nearest bump.

Where samples make or break a contact the likelihood has bumps of a few nats, and a fit ends on one of them: as far from
the top as that many nats are. Regressing the likelihood at points drawn about the fit averages over the bumps, says
where the top is and how well that is known, and whether it is as sharp as sensitivities say.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, losses_at, sds
from det2stoc_bayes.mismatch.contact.regions import border_unknowns

FAR = 2.0  # sds about the fit
EACH, LEAST = 8, 40  # points for each unknown, and in all
ROUNDS = 2
FARTHEST = 3.0  # sds that a round may lead
LUCKY = 3.0  # times the bumps: what is told so much worse is not the top
SHARPNESS = 0.2, 1.5  # of the quadratic, of what sensitivities say


def topped(fit: ContactFit, random: np.random.Generator) -> ContactFit:
    """The hypothesis at the top, its covariance widened by what the bumps leave unknown of it."""
    for _ in range(ROUNDS):
        q = _quadratic(fit, random)
        if q is None:
            break
        step = -q.slope / q.sharp
        step *= min(1.0, FARTHEST / max(float(np.linalg.norm(step)), 1e-12))
        apart = q.bumps**2 * np.linalg.inv(q.design.T @ q.design)[1:, 1:] / q.sharp**2
        there = at(fit.followed, np.maximum(fit.z + q.root @ step, fit.followed.problem.floor))
        there = there if there.loss < fit.loss + LUCKY * q.bumps else fit
        fit = replace(there, sizes=fit.differences[1], sharp=q.sharp, rough=q.root @ apart @ q.root.T)
    return fit


def widened(fit: ContactFit, z: Float[np.ndarray, " size"]) -> ContactFit:
    """The hypothesis, its covariance widened by how far from it another search for its top has ended."""
    apart = np.outer(fit.z - z, fit.z - z)
    return replace(fit, rough=apart if fit.rough is None else fit.rough + apart)


def bumps(fit: ContactFit, random: np.random.Generator) -> float:
    """How high the likelihood's bumps about a fit are, nats: by so much fits of one hypothesis may differ."""
    q = _quadratic(fit, random)
    return 0.0 if q is None else q.bumps


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """A quadratic through the likelihood at points about a fit, in coordinates that `root` makes unknowns of."""

    root: Float[np.ndarray, "size free"]
    design: Float[np.ndarray, "points free+1"]
    slope: Float[np.ndarray, " free"]
    sharp: float
    bumps: float  # nats


def _quadratic(fit: ContactFit, random: np.random.Generator) -> _Quadratic | None:
    """None where nothing is free; where a region ends stays as it is, for it has no curvature."""
    free = np.setdiff1d(np.arange(len(fit.z)), border_unknowns(fit))
    if not len(free):
        return None
    root = np.zeros((len(fit.z), len(free)))
    root[free] = sds(fit.gram[np.ix_(free, free)])
    half = FAR * random.standard_normal((max(EACH * len(free), LEAST) // 2, len(free)))
    z = np.maximum(fit.z + np.concatenate([half, -half]) @ root.T, fit.followed.problem.floor)
    u = np.linalg.lstsq(root, (z - fit.z).T, rcond=None)[0].T
    heights = losses_at(fit, z)
    design = np.column_stack([np.ones(len(u)), u, 0.5 * (u**2).sum(1)])
    sharp = float(np.clip(_robust(design, heights)[-1], *SHARPNESS))
    rest, design = heights - sharp * design[:, -1], design[:, :-1]
    line = _robust(design, rest)
    tau = 1.4826 * float(np.median(np.abs(rest - design @ line)))
    return _Quadratic(root, design, line[1:], sharp, tau)


def _robust(design: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least squares, reweighted so that a few points far off do not count (Huber)."""
    weight = np.ones(len(values))
    for _ in range(20):
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(root * design, root[:, 0] * values, rcond=None)[0]
        left = values - design @ found
        scale = 1.345 * 1.4826 * max(float(np.median(np.abs(left))), 1e-9)
        weight = np.minimum(1.0, scale / np.maximum(np.abs(left), 1e-12))
    return found
