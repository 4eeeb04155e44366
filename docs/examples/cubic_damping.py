"""Friction that grows with the cube of speed: an effect that the catalogue does not have."""

from det2stoc_bayes.mismatch.effects.base import EffectParameter, normal
from det2stoc_bayes.mismatch.effects.joint import JointEffect


class CubicDamping(JointEffect):
    """Friction that grows with the cube of speed."""

    name, law, law_text = "cubic_damping", r"-c\,v^3", "-c v^3"
    noun = "Cubic damping"
    parameters = (EffectParameter("coefficient", ("N s3/m3", "N m s3/rad3"), positive=True),)

    def priors(self, typical):
        """At the typical speed a fraction of the typical force."""
        return {"coefficient": normal(0.3 * typical.force / typical.speed**3)}

    def joint_force(self, p, s, xp):
        """Against the motion; works on arrays of either library."""
        return -p["coefficient"] * s.v**3
