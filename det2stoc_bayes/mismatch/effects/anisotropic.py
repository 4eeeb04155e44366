"""Friction of a contact that depends on the way in which it slides, as on brushed metal, fabric or rolled tracks."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, normal
from det2stoc_bayes.mismatch.effects.contact import LEAST, slid
from det2stoc_bayes.mismatch.effects.momentary_friction import MomentaryFriction
from det2stoc_bayes.priors import Prior

LITTLE = 1.004  # a ratio to screen by, 1 % of its prior's sd from none
QUARTER = np.pi / 4  # between two directions whose mixtures are all others


class AnisotropicFriction(MomentaryFriction):
    """Sliding friction is another along one direction of the ground than across it.

    Its size is that of an ellipse of frictions (Zmitrowicz, 1981); it acts against the motion, and not aside from it.
    """

    name = "anisotropic_friction"
    law = r"\mu\sqrt{\rho^2\cos^2\varphi+\sin^2\varphi}"
    law_text = "mu sqrt(ratio^2 cos^2 + sin^2) of the angle from the direction (world x towards y) to the motion"
    noun = "A friction of other size along a direction"
    parameters = (EffectParameter("ratio", "1", absent=1.0), EffectParameter("direction", "rad"))
    complexity = 3

    def priors(self, typical):
        """Around 1; anywhere within half a turn, which is all that there is."""
        return {"ratio": Prior("Normal", {"loc": 1.0, "scale": 0.4}), "direction": normal(1.0)}

    def trials(self, typical):
        """Along x, and half-way to y: to first order any direction is a mixture of these and of friction."""
        return [Trial(tuple({"ratio": LITTLE, "direction": turn} for turn in (0.0, QUARTER)))]

    def combine(self, trial, coefficients, typical):
        """The direction in which both add up."""
        along, diagonal = coefficients
        size = float(np.hypot(along, diagonal)) * (LITTLE - 1)
        return {"ratio": 1.0 + size, "direction": 0.5 * float(np.arctan2(diagonal, along))}

    def moment(self, p, fields, s, at, xp):
        """Squared cosine of the angle between the direction and the motion over the ground."""
        along = s.v[..., 0] * xp.cos(p["direction"]) + s.v[..., 1] * xp.sin(p["direction"])
        return along**2 / xp.maximum(s.v[..., 0] ** 2 + s.v[..., 1] ** 2, LEAST**2)

    def changed(self, p, friction, solref, dim, xp):
        """Sliding friction by the way of the motion."""
        return slid(friction, xp.sqrt(1 + (p["ratio"] ** 2 - 1) * p["moment"]), xp), solref, dim
