"""Effects of a contact beyond dry friction: what sticks, and what rubs the more the faster it slides."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, normal
from det2stoc_bayes.mismatch.effects.contact import GEOM, MIXED, PAIR, rewritten, rewritten_pair

SHARE = 0.5  # of a body's weight: what an adhesion may be
LEAST_SPEED = 1e-9  # m/s
STEEPEST = 0.7  # cosine of a slope


def same(p, friction, solref, dim, xp):
    """The contact as it is, by parameters of its own."""
    return friction, solref, dim


class Adhesion(Effect):
    """Each point of contact is pulled on by a force along its normal, as MuJoCo's geom/adhesion has it."""

    name, kind, law, law_text = "adhesion", "contact", r"F", "a pull of F on each point of contact"
    noun = "Adhesion"
    parameters = (EffectParameter("force", "N", positive=True),)
    changes = (*GEOM, *MIXED, "geom_adhesion")
    in_mjx_fields = False
    complexity = 2

    def forms(self):
        """For geoms, and for pairs that the model lists."""
        return (self, PairedAdhesion())

    def priors(self, typical):
        """A part of the weight."""
        return {"force": normal(SHARE * typical.force)}

    def fields(self, p, fields, at, xp):
        """Of the second geom; what both have adds up unless one has priority."""
        a, b = at.geoms
        own, first = fields["geom_adhesion"], fields["geom_priority"]
        over = xp.where(first[..., b] > first[..., a], own[..., b], own[..., a])
        mine = xp.where(first[..., a] == first[..., b], own[..., a] + own[..., b], over)
        row = np.arange(own.shape[-1]) == b
        sticky = xp.where(row, (mine + xp.maximum(p["force"], 0.0))[..., None], own)
        return {**rewritten(same, p, fields, at, xp), "geom_adhesion": sticky}


class PairedAdhesion(Adhesion):
    """The same for a pair that the model lists."""

    changes = ("pair_adhesion",)
    needs = frozenset({"paired"})

    def fields(self, p, fields, at, xp):
        """Adds to the pair's."""
        own = fields["pair_adhesion"]
        return {"pair_adhesion": own + xp.maximum(p["force"], 0.0)[..., None] * (np.arange(own.shape[-1]) == at.pair)}


class ViscousContactFriction(Effect):
    """What slides is slowed in proportion to its speed as well, while it touches.

    Friction is mu + c |v| / N, where N is the body's weight: where it slides on the ground the force is -c v.
    """

    name, kind, law, law_text = "viscous_contact_friction", "contact", r"-c\,\mathbf v", "-c v while they touch"
    noun = "Viscous friction of contact"
    parameters = (EffectParameter("coefficient", "N s/m", positive=True),)
    needs = frozenset({"free", "named"})
    writes = GEOM
    reads = (*MIXED, "body_mass", "opt.gravity")
    in_mjx_fields = False
    complexity = 2

    def forms(self):
        """For geoms, and for pairs that the model lists."""
        return (self, PairedViscousContactFriction())

    def priors(self, typical):
        """A force as large as the body's, at its usual speed."""
        return {"coefficient": normal(SHARE * typical.force / typical.speed)}

    def momentary(self, p, fields, s, at, xp):
        """The contact's sliding friction for the step that begins."""
        return rewritten(rubbed, {**p, "more": more_friction(p, fields, s, at, xp)}, fields, at, xp)


def more_friction(p, fields, s, at, xp):
    """c |v| over the body's weight, both across gravity's and the motion's directions: what falls does not slide."""
    gravity, speed = fields["opt.gravity"], xp.sqrt(xp.sum(s.v**2, -1))
    size = xp.sqrt(xp.sum(gravity**2, -1))
    along = xp.sum(gravity * s.v, -1) / xp.maximum(speed * size, LEAST_SPEED)
    across = xp.sqrt(xp.maximum(1 - along**2, 0.0))  # sine of the angle between them
    weight = fields["body_mass"][..., at.body] * size * xp.maximum(across, STEEPEST)
    return xp.maximum(p["coefficient"], 0.0) * speed * across / xp.maximum(weight, LEAST_SPEED)


def rubbed(p, friction, solref, dim, xp):
    """Sliding friction and something more."""
    return xp.concatenate([friction[..., :1] + p["more"][..., None], friction[..., 1:]], -1), solref, dim


class PairedViscousContactFriction(ViscousContactFriction):
    """The same for a pair that the model lists."""

    needs = frozenset({"free", "named", "paired"})
    writes, reads = PAIR, ("body_mass", "opt.gravity")

    def momentary(self, p, fields, s, at, xp):
        """The pair's sliding friction for the step that begins."""
        return rewritten_pair(rubbed, {**p, "more": more_friction(p, fields, s, at, xp)}, fields, at, xp)
