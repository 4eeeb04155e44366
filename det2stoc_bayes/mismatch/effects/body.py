"""Effects on bodies."""

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter
from det2stoc_bayes.mismatch.effects.joint import normal


class QuadraticDrag(Effect):
    """Drag on a body's centre of mass, growing with the square of its speed."""

    name, kind, law, law_text = "quadratic_drag", "body", r"-c\,|\mathbf v|\,\mathbf v", "-c abs(v) v"
    parameters = (EffectParameter("coefficient", "kg/m", positive=True),)
    complexity = 2

    def priors(self, typical):
        """At the body's typical speed a fraction of the typical force."""
        return {"coefficient": normal(0.3 * typical.force / typical.speed**2)}

    def body_force(self, p, s, xp):
        """Against the velocity through still air."""
        speed = xp.sqrt(xp.sum(s.velocity**2, -1, keepdims=True) + 1e-30)
        return -p["coefficient"][..., None] * speed * s.velocity
