"""A contact that sticks."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, normal
from det2stoc_bayes.mismatch.effects.contact import GEOM, MIXED, rewritten

SHARE = 0.5  # of a body's weight: what an adhesion may be


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
