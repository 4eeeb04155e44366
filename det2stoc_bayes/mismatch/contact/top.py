"""The top of a likelihood that contact makes rough: a quadratic through many points about a fit, not its nearest bump.

Where samples make or break a contact the likelihood has bumps of a few nats, and a fit ends on one of them: as far from
the top as that many nats are. Sensitivities found on bumps are too large, most of all along valleys. Regressing the
likelihood at points drawn about the fit averages over the bumps, says where the top is and how well that is known, and
how sharp it is each way. The points lie as far off as a top must fall to be seen among bumps.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, losses_at, sds, within
from det2stoc_bayes.mismatch.contact.regions import free_unknowns

FAR = 2.0  # sds about the fit, at least
EACH, LEAST = 8, 40  # points for each unknown, and at least
ROUGHLY = 0.6  # of these where only the height of bumps is asked for
ROUNDS = 2
STILL, ALIKE = 0.5, 0.5  # sds that a round leads, and of the sharpness before: by less, and to more, it is the last
FARTHEST = 3.0  # sds that a round may lead
LUCKY = 3.0  # times the bumps: what is told so much worse is not the top
UNTOLD = 1e-3  # of the prior's curvature, the most that recordings add of which they say nothing
BLUNTEST = 0.05  # each way, of what the round before says
RIGHT = 0.7  # sharpness where sensitivities are right: reweighting takes errors for Gaussian


def topped(fit: ContactFit, random: np.random.Generator) -> ContactFit:
    """The hypothesis at the top, its covariance widened by what sensitivities and bumps leave unknown of it."""
    ways = _ways(fit)
    wider = np.ones(ways.shape[1])
    if not len(wider):
        return fit
    far = max(FAR, float(np.sqrt(2 * bumps(fit, random))))
    for _ in range(ROUNDS):
        q = _quadratic(fit, ways, far, random)
        step = -q.slope / q.sharp
        step *= min(1.0, FARTHEST / max(float(np.linalg.norm(np.sqrt(q.sharp) * step)), 1e-12))
        apart = q.bumps**2 * np.linalg.inv(q.design.T @ q.design)[1:, 1:] / np.outer(q.sharp, q.sharp)
        there = at(fit.followed, within(fit, fit.z + ways @ step))
        there = there if there.loss < fit.loss + LUCKY * q.bumps else fit
        fit = replace(there, sizes=fit.steps, rough=ways @ apart @ ways.T)
        sharp = np.minimum(q.sharp, wider)  # no top is called sharper than sensitivities have it
        led = float(np.linalg.norm(np.sqrt(q.sharp) * step))
        wider, ways = wider / sharp, ways / np.sqrt(sharp)
        if led < STILL and sharp.min() > ALIKE:
            break
    return replace(fit, flat=_stretched(ways, wider))


def _ways(fit: ContactFit) -> Float[np.ndarray, "size free"]:
    """By which draws of unit variance are scattered as unknowns are.

    Where a region ends stays, for it has no curvature, and what recordings say nothing of there: it may further off.
    """
    free = free_unknowns(fit)
    free = free[(fit.told**2).sum((0, 1))[free] > UNTOLD] if len(free) else free
    ways = np.zeros((len(fit.z), len(free)))
    if len(free):
        ways[free] = sds(fit.gram[np.ix_(free, free)])
    return ways


def _stretched(
    ways: Float[np.ndarray, "size free"], wider: Float[np.ndarray, " free"]
) -> Float[np.ndarray, "size size"]:
    """By which the sds of sensitivities become those of a top that is `wider` times as flat each way.

    What flattens a curvature that sensitivities have exaggerated has exaggerated their scatter as well.
    """
    free = np.flatnonzero(ways.any(1))
    root = ways[free]
    out = np.eye(len(ways))
    stretch = wider * np.sqrt(np.minimum(1.0, 1 / (RIGHT * wider)))
    out[np.ix_(free, free)] = root @ np.diag(stretch) @ np.linalg.inv(root)
    return out


def widened(fit: ContactFit, *ends: Float[np.ndarray, " size"]) -> ContactFit:
    """The hypothesis, its covariance widened by how far from it other searches for its top have ended."""
    if not ends:
        return fit
    apart = np.stack(ends) - fit.z
    rough = apart.T @ apart / len(ends)
    wide = replace(fit, rough=rough if fit.rough is None else fit.rough + rough)
    wide.__dict__.update((k, v) for k, v in fit.__dict__.items() if k == "differences")  # they are the same
    return wide


def bumps(fit: ContactFit, random: np.random.Generator) -> float:
    """How high the likelihood's bumps about a fit are, nats: by so much fits of one hypothesis may differ."""
    ways = _ways(fit)
    return _quadratic(fit, ways, FAR, random, ROUGHLY).bumps if ways.shape[1] else 0.0


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """A quadratic through the likelihood at points about a fit, in coordinates that its ways make unknowns of."""

    slope: Float[np.ndarray, " free"]
    sharp: Float[np.ndarray, " free"]
    design: Float[np.ndarray, "points free+1"]
    bumps: float  # nats


def _quadratic(
    fit: ContactFit, ways: Float[np.ndarray, "size free"], far: float, random: np.random.Generator, part: float = 1.0
) -> _Quadratic:
    """Through points so `far` from a fit, where the prior lets them be; no way it is blunter than the prior."""
    count = ways.shape[1]
    half = far * random.standard_normal((int(part * max(EACH * count, LEAST)) // 2, count))
    z = within(fit, fit.z + np.concatenate([half, -half]) @ ways.T)
    u = np.linalg.lstsq(ways, (z - fit.z).T, rcond=None)[0].T
    heights = losses_at(fit, z)
    design = np.column_stack([np.ones(len(u)), u, 0.5 * u**2])
    sharp = np.maximum(_robust(design, heights)[1 + count :], np.maximum(BLUNTEST, (ways**2).sum(0)))
    rest, design = heights - design[:, 1 + count :] @ sharp, design[:, : 1 + count]
    line = _robust(design, rest)
    tau = 1.4826 * float(np.median(np.abs(rest - design @ line)))
    return _Quadratic(line[1:], sharp, design, tau)


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
