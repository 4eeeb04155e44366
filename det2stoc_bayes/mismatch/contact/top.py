"""The top of a likelihood that contact makes rough: a quadratic through many points about a fit, not its nearest bump.

Where samples make or break a contact the likelihood has bumps of a few nats, and a fit ends on one of them: as far from
the top as that many nats are. Regressing the likelihood at points drawn about the fit averages over the bumps, says
where the top is and how well that is known, and whether it is as sharp as sensitivities say.
"""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import ContactFit, at
from det2stoc_bayes.mismatch.contact.scales import scales_of

FAR = 2.0  # sds about the fit
EACH, LEAST = 8, 40  # points for each unknown, and in all
ROUNDS = 2
FARTHEST = 3.0  # sds that a round may lead
SHARPNESS = 0.2, 1.5  # of the quadratic, of what sensitivities say


def topped(fit: ContactFit, random: np.random.Generator) -> ContactFit:
    """The hypothesis at the top, its covariance widened by what the bumps leave unknown of it."""
    for _ in range(ROUNDS if len(fit.z) else 0):
        fit = _round(fit, random)
    return fit


def _round(fit: ContactFit, random: np.random.Generator) -> ContactFit:
    size = len(fit.z)
    root = np.linalg.cholesky(np.linalg.inv(fit.gram))
    half = FAR * random.standard_normal((max(EACH * size, LEAST) // 2, size))
    z = np.maximum(fit.z + np.concatenate([half, -half]) @ root.T, fit.followed.problem.floor)
    u = np.linalg.solve(root, (z - fit.z).T).T
    errors = fit.followed.errors(z)
    heights = np.array([scales_of(e).losses(e).sum() for e in errors]) + 0.5 * (z**2).sum(1)
    design = np.column_stack([np.ones(len(u)), u, 0.5 * (u**2).sum(1)])
    found = _robust(design, heights)
    sharp = float(np.clip(found[-1], *SHARPNESS))
    rest = heights - sharp * design[:, -1]
    line = _robust(design[:, :-1], rest)
    left = rest - design[:, :-1] @ line
    tau = 1.4826 * float(np.median(np.abs(left)))
    step = -line[1:] / sharp
    step *= min(1.0, FARTHEST / max(float(np.linalg.norm(step)), 1e-12))
    apart = tau**2 * np.linalg.inv(design[:, :-1].T @ design[:, :-1])[1:, 1:] / sharp**2
    there = at(fit.followed, np.maximum(fit.z + root @ step, fit.followed.problem.floor))
    return replace(there, sizes=fit.differences[1], sharp=sharp, rough=root @ apart @ root.T)


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
