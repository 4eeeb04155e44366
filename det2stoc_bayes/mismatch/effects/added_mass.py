"""Inertia without weight: the fluid that a body takes along."""

from det2stoc_bayes.mismatch.effects.base import EffectParameter, normal, onehot
from det2stoc_bayes.mismatch.effects.body import BodyEffect


class AddedMass(BodyEffect):
    """A point mass at the centre of mass that has no weight."""

    name, law_text, noun = "added_mass", "-m dv/dt", "Added mass"
    law = r"-m\,\dot{\mathbf v}"
    parameters = (EffectParameter("mass", "kg", positive=True),)
    changes = ("body_mass", "body_gravcomp")
    complexity = 2

    def priors(self, typical):
        """A fraction of the mass."""
        return {"mass": normal(0.3 * typical.inertia)}

    def fields(self, p, fields, at, xp):
        """More mass, of whose weight as much is taken off."""
        mass, gravcomp = fields["body_mass"], fields["body_gravcomp"]
        place, own = onehot(mass.shape[-1], at.body), mass[..., at.body]
        share = (1 - gravcomp[..., at.body]) * p["mass"] / (own + p["mass"])
        return {
            "body_mass": mass + p["mass"][..., None] * place,
            "body_gravcomp": gravcomp + share[..., None] * place,
        }
