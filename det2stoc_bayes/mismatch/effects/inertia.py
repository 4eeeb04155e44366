"""Errors of a body's mass distribution."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import SMALL, EffectParameter, Trial, normal, onehot, unit_columns
from det2stoc_bayes.mismatch.effects.body import BodyEffect
from det2stoc_bayes.priors import Prior

SPLIT = 1e-9  # of the moments' sum, by which equal ones are told apart
HEAVY = 0.5  # of a body's mass, a payload's prior scale
REACH = 2.5  # radii of gyration from a body's frame within which a payload is looked for first


class MassError(BodyEffect):
    """The body is heavier or lighter than believed, inertia scaled along."""

    name, law, law_text, noun = "mass_error", r"m + \Delta m", "m + mass", "A change of mass"
    parameters = (EffectParameter("mass", "kg"),)
    needs = frozenset({"loose"})
    changes = ("body_mass", "body_inertia")

    def priors(self, typical):
        """A fraction of the mass."""
        return {"mass": normal(0.2 * typical.inertia)}

    def fields(self, p, fields, at, xp):
        """Mass and inertia of the one body."""
        mass, place = fields["body_mass"], onehot(fields["body_mass"].shape[-1], at.body)
        changed = mass + p["mass"][..., None] * place
        ratio = 1 + (p["mass"] / mass[..., at.body])[..., None] * place
        return {"body_mass": changed, "body_inertia": fields["body_inertia"] * ratio[..., None]}


class ComOffset(BodyEffect):
    """The centre of mass lies elsewhere in the body."""

    name, law, law_text, noun = "com_offset", r"\mathbf c + \mathbf d", "centre + offset", "A shift of the centre"
    parameters = (EffectParameter("offset", "m", size=3),)
    needs = frozenset({"loose"})
    changes = ("body_ipos",)
    complexity = 2

    def priors(self, typical):
        """A fraction of the body's radius of gyration."""
        return {"offset": normal(0.3 * typical.span)}

    def fields(self, p, fields, at, xp):
        """Moves the inertial frame."""
        ipos = fields["body_ipos"]
        return {"body_ipos": ipos + p["offset"][..., None, :] * onehot(ipos.shape[-2], at.body)[:, None]}


class InertiaError(BodyEffect):
    """Principal moments of inertia are off, each by its own ratio."""

    name, law, law_text, noun = "inertia_error", r"\rho_i\,I_i", "ratio_i I_i", "A change of inertia"
    parameters = (EffectParameter("ratio", "1", absent=1.0, size=3),)
    needs = frozenset({"loose"})
    changes = ("body_inertia",)
    complexity = 2

    def priors(self, typical):
        """Around 1."""
        return {"ratio": Prior("Normal", {"loc": 1.0, "scale": 0.3})}

    def fields(self, p, fields, at, xp):
        """Scales the moments about the principal axes."""
        inertia = fields["body_inertia"]
        place = onehot(inertia.shape[-2], at.body)[:, None]
        return {"body_inertia": inertia * (1 + (p["ratio"] - 1)[..., None, :] * place)}


class PayloadMass(BodyEffect):
    """A point mass that is fixed to the body."""

    name, law_text, noun = "payload_mass", "a point mass at offset in the body's frame", "A payload"
    law = r"m_p\ \text{at}\ \mathbf d"
    parameters = (EffectParameter("mass", "kg", positive=True), EffectParameter("offset", "m", size=3))
    needs = frozenset({"loose"})
    changes = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
    in_mjx_fields = False  # principal axes have no derivative where moments are equal
    complexity = 3

    def priors(self, typical):
        """A load may be as heavy as what carries it, 2 sds out, and within a few radii of gyration."""
        return {"mass": normal(HEAVY * typical.inertia), "offset": normal(2 * typical.span)}

    def trials(self, typical):
        """A small mass at the frame's origin, and what its first moment adds, for two reaches; and one on each axis.

        In the mass's first order a column at an offset is mass + first moment + second moment.
        """
        mass, (_, offset) = SMALL * HEAVY * typical.inertia, self.parameters
        near, far = (unit_columns(offset, reach * typical.span, mass=mass) for reach in (0.7, REACH))
        opposite = unit_columns(offset, -REACH * typical.span, mass=mass)
        at_origin = {"mass": mass, "offset": (0.0, 0.0, 0.0)}
        return [Trial((at_origin, *near)), Trial((at_origin, *far)), *(Trial((c,)) for c in (*far, *opposite))]

    def combine(self, trial, coefficients, typical):
        """Masses add up, and so do first moments.

        Where an uncertain mass of the body takes the payload's, the moment stays: it is then within reach of the body.
        """
        mass, offsets = trial.columns[0]["mass"], np.array([column["offset"] for column in trial.columns])
        moment = mass * coefficients @ offsets
        total = max(float(np.sum(coefficients)) * mass, np.linalg.norm(moment) / (REACH * typical.span), mass)
        return {"mass": total, "offset": moment / total}

    def fields(self, p, fields, at, xp):
        """Mass, centre, principal moments and axes of the two together."""
        mass, centre = fields["body_mass"][..., at.body], fields["body_ipos"][..., at.body, :]
        total = mass + p["mass"]
        joint = (mass[..., None] * centre + p["mass"][..., None] * p["offset"]) / total[..., None]
        own = rotation(fields["body_iquat"][..., at.body, :], xp)
        moments = fields["body_inertia"][..., at.body, :]
        tensor = xp.einsum("...ik,...k,...jk->...ij", own, moments, own)
        tensor = tensor + point_inertia(mass, centre - joint, xp) + point_inertia(p["mass"], p["offset"] - joint, xp)
        # Across equal moments any axes would do, but a fluid's drag depends on them: they must not jump.
        split = SPLIT * xp.sum(moments, -1)[..., None] * np.arange(3.0)
        _, axes = xp.linalg.eigh(tensor + xp.einsum("...ik,...k,...jk->...ij", own, split, own))
        moments = xp.einsum("...ki,...kl,...li->...i", axes, tensor, axes)
        axes = axes * xp.sign(xp.linalg.det(axes))[..., None, None]
        row = onehot(fields["body_mass"].shape[-1], at.body) > 0
        vectors = {"body_ipos": joint, "body_inertia": moments, "body_iquat": quaternion(axes, xp)}
        out = {n: xp.where(row[:, None], v[..., None, :], fields[n]) for n, v in vectors.items()}
        return {"body_mass": xp.where(row, total[..., None], fields["body_mass"]), **out}


def point_inertia(mass, offset, xp):
    """Inertia about the origin of a point mass at an offset."""
    square = xp.sum(offset**2, -1)[..., None, None] * np.eye(3)
    return mass[..., None, None] * (square - offset[..., :, None] * offset[..., None, :])


def rotation(quaternion, xp):
    """Matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def quaternion(matrix, xp):
    """Unit quaternion of a rotation matrix, by Bar-Itzhack's eigenvector (J. Guidance 23(6), 2000)."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    rows = (
        (xx + yy + zz, wx, wy, wz),
        (wx, xx - yy - zz, xy, xz),
        (wy, xy, yy - xx - zz, yz),
        (wz, xz, yz, zz - xx - yy),
    )
    return xp.linalg.eigh(xp.stack([xp.stack(row, -1) for row in rows], -2))[1][..., -1]
