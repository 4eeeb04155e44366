"""Friction of a contact that depends on the moment: on where a body is, on how fast it slides."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, normal
from det2stoc_bayes.mismatch.effects.contact import GEOM, LEAST, MIXED, OnContact, slid
from det2stoc_bayes.priors import Prior

SHARE = 0.5  # of a body's weight: what friction may be at its usual speed
LEAST_SPEED = 1e-9  # m/s
STEEPEST = 0.7  # cosine of a slope


class MomentaryFriction(OnContact):
    """Base: friction for the step that begins is `changed` by p and its `moment`; it is of a free body."""

    needs = frozenset({"free", "named"})
    writes = GEOM
    reads = MIXED

    def moment(self, p, fields, s, at, xp):
        """What friction depends on, of the body's state."""
        raise NotImplementedError

    def momentary(self, p, fields, s, at, xp):
        """The contact's parameters for the step that begins."""
        return self.written({**p, "moment": self.moment(p, fields, s, at, xp)}, fields, at, xp)


class FrictionPatch(MomentaryFriction):
    """Beyond a plane the ground is rougher or smoother; what counts is where the moving body's frame is."""

    name, law_text = "friction_patch", "ratio mu where (x - point).normal > 0"
    law, noun = r"\rho\,\mu \text{ where } (\mathbf x - \mathbf p)\cdot\mathbf n > 0", "A region of other friction"
    parameters = (
        EffectParameter("ratio", "1", absent=1.0),
        EffectParameter("point", "m", size=3),
        EffectParameter("normal", "1", size=3),
    )
    complexity = 4

    def priors(self, typical):
        """Around 1; anywhere where the body was; any direction."""
        places = np.array(typical.region) if typical.region else np.zeros((1, 3))
        wide = float(max(places.std(0).max(), 1e-2))
        return {
            "ratio": Prior("Normal", {"loc": 1.0, "scale": 0.4}),
            "point": Prior("Normal", {"loc": 0.0, "scale": float(np.abs(places).max()) + wide}),
            "normal": Prior("Normal", {"loc": 0.0, "scale": 1.0}),
        }

    def from_normal(self, z, typical, xp=np):
        """The normal has unit length."""
        out = super().from_normal(z, typical, xp)
        length = xp.sqrt(xp.sum(out["normal"] ** 2, -1))[..., None]
        return out | {"normal": out["normal"] / xp.maximum(length, LEAST)}

    def trials(self, typical):
        """Planes across each axis and the diagonals of the ground, at several places."""
        if not typical.region:
            return []
        places = np.array(typical.region)
        flat = places[:, :2] - places[:, :2].mean(0)
        turns = np.arange(4) * np.pi / 4
        out = []
        for turn in turns:
            normal = np.array([np.cos(turn), np.sin(turn), 0.0])
            along = flat @ normal[:2]
            if np.ptp(along) < 0.2 * np.ptp(flat):
                continue
            for q in (0.25, 0.5, 0.75):
                point = places.mean(0) + float(np.quantile(along, q)) * normal
                out.append(Trial(({"ratio": 1.004, "point": tuple(point), "normal": tuple(normal)},)))
        return out

    def moment(self, p, fields, s, at, xp):
        """1 where the body's frame is on the normal's side of the plane, else 0."""
        return xp.where(xp.sum((s.q - p["point"]) * p["normal"], -1) > 0, 1.0, 0.0)

    def changed(self, p, friction, solref, dim, xp):
        """Sliding friction times the ratio where the body is inside."""
        return slid(friction, 1 + (p["ratio"] - 1) * p["moment"], xp), solref, dim


class ViscousContactFriction(MomentaryFriction):
    """What slides is slowed in proportion to its speed as well, while it touches.

    Friction is mu + c |v| / N, where N is the body's weight: where it slides on the ground the force is -c v.
    """

    name, law, law_text = "viscous_contact_friction", r"-c\,\mathbf v", "-c v while they touch"
    noun = "Viscous friction of contact"
    parameters = (EffectParameter("coefficient", "N s/m", positive=True),)
    reads = (*MIXED, "body_mass", "opt.gravity")
    complexity = 2

    def priors(self, typical):
        """A force as large as the body's, at its usual speed."""
        return {"coefficient": normal(SHARE * typical.force / typical.speed)}

    def moment(self, p, fields, s, at, xp):
        """c |v| over the body's weight, both across gravity's and the motion's ways: what falls does not slide."""
        gravity, speed = fields["opt.gravity"], xp.sqrt(xp.sum(s.v**2, -1))
        size = xp.sqrt(xp.sum(gravity**2, -1))
        along = xp.sum(gravity * s.v, -1) / xp.maximum(speed * size, LEAST_SPEED)
        across = xp.sqrt(xp.maximum(1 - along**2, 0.0))  # sine of the angle between them
        weight = fields["body_mass"][..., at.body] * size * xp.maximum(across, STEEPEST)
        return xp.maximum(p["coefficient"], 0.0) * speed * across / xp.maximum(weight, LEAST_SPEED)

    def changed(self, p, friction, solref, dim, xp):
        """Sliding friction and something more."""
        return xp.concatenate([friction[..., :1] + p["moment"][..., None], friction[..., 1:]], -1), solref, dim
