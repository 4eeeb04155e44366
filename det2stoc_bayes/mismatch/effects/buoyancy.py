"""A body's buoyancy in the fluid that surrounds it."""

from det2stoc_bayes.mismatch.effects.base import EffectParameter, normal, onehot
from det2stoc_bayes.mismatch.effects.body import AIR, BodyEffect


class Buoyancy(BodyEffect):
    """What the displaced fluid weighs, upwards at the centre of mass; air where the model has no density."""

    name, law_text, noun = "buoyancy", "-rho V g", "Buoyancy"
    law = r"-\rho V\,\mathbf g"
    parameters = (EffectParameter("volume", "m3", positive=True),)
    changes = ("body_gravcomp", "body_mass", "opt.density")
    complexity = 2

    def priors(self, typical):
        """A fraction of the body's own weight."""
        return {"volume": normal(0.3 * typical.inertia / density_of(typical.density))}

    def fields(self, p, fields, at, xp):
        """As a share of the weight, which MuJoCo takes off."""
        gravcomp, density = fields["body_gravcomp"], fields["opt.density"]
        surrounding = xp.where(density > 0, density, AIR).reshape(p["volume"].shape)
        share = surrounding * p["volume"] / fields["body_mass"][..., at.body]
        return {**fields, "body_gravcomp": gravcomp + share[..., None] * onehot(gravcomp.shape[-1], at.body)}


def density_of(density):
    """The fluid's, or air's."""
    return density if density > 0 else AIR
