"""Vectors in the world of which recordings tell one component well: with others turned they tell nearly as much.

What slides on a plane feels how fast a frame turns about the plane's normal, and hardly to which side the rest of the
turn is. A fit ends at whichever of such tops is nearer, so the others are looked at.
"""

from itertools import product

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.layout import FREE
from det2stoc_bayes.mismatch.contact.fit import ContactFit, fit_followed, fits_at

AXES = 3
NUM_TURNED = 2  # of the likeliest, that are fitted
FLIPS = np.array([f for f in product((1.0, -1.0), repeat=AXES) if min(f) < 0])


def best_turned(fit: ContactFit, settled: float) -> ContactFit:
    """A hypothesis, or where it is likelier: its last effect's vector turned about the axes in which bodies move."""
    first = _vector(fit)
    if first is None:
        return fit
    axes, here = _axes(fit), slice(first, first + AXES)
    ways = np.tile(fit.z, (len(FLIPS), 1))
    ways[:, here] = (FLIPS * (axes @ fit.z[here])) @ axes
    begun = sorted(fits_at(fit.followed, ways), key=lambda f: f.loss)[:NUM_TURNED]

    def fitted(one: ContactFit) -> ContactFit:
        return fit_followed(one.followed, one.z, like=fit, settled=settled, needed=max(one.loss - fit.loss, 0.0))

    return min([fit, *map(fitted, begun)], key=lambda f: f.loss)


def _vector(fit: ContactFit) -> int | None:
    """Where the unknowns of the last effect's vector in the world begin; None where it has none."""
    placed = fit.problem.effects[-1]
    begin = fit.problem.size - placed.size
    for parameter in placed.effect.unknown if placed.element.kind == "world" else ():
        if parameter.size == AXES:
            return begin
        begin += parameter.size
    return None


def _axes(fit: ContactFit) -> Float[np.ndarray, "3 3"]:
    """Principal axes (rows) of the speeds that free bodies have, else the world's."""
    model = fit.problem.simulator.model
    dofs = model.jnt_dofadr[model.jnt_type == FREE]
    if not len(dofs):
        return np.eye(AXES)
    speeds = fit.followed.path(fit.z).qvel
    speeds = np.concatenate([speeds[..., d : d + AXES].reshape(-1, AXES) for d in dofs])
    return np.linalg.svd(speeds[np.isfinite(speeds).all(1)], full_matrices=False)[2]
