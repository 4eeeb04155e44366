"""A stop that ends a joint's travel on one side."""

from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, onehot
from det2stoc_bayes.mismatch.effects.joint import JointEffect
from det2stoc_bayes.priors import Prior

FULL = 2.0  # prior scale of a coefficient whose column stands at full size
DEPTHS = (0.003, 0.03, 0.1, 0.25)  # of the recorded travel, from its ends
FAR = 1e10  # m or rad: a limit that is none


class HardStop(JointEffect):
    """A unilateral stop (MuJoCo's joint limit); the middle of the recorded travel is on its free side."""

    name, law, law_text, noun = "hard_stop", r"q \lessgtr q_s", "q stays on one side of position", "A hard stop"
    parameters = (EffectParameter("position", ("m", "rad"), absent=float("inf")),)
    changes = ("jnt_range", "jnt_limited")
    complexity = 2

    def priors(self, typical):
        """Somewhere in the travel, or a little beyond."""
        low, high = typical.reach
        return {"position": Prior("Normal", {"loc": 0.5 * (low + high), "scale": 0.5 * (high - low)})}

    def trials(self, typical):
        """A few places near both ends."""
        low, high = typical.reach
        places = [end for f in DEPTHS for end in (low + f * (high - low), high - f * (high - low))]
        return [Trial(({"position": place},), FULL, one_sided=True) for place in places]

    def combine(self, trial, coefficients, typical):
        """The trial's own place."""
        return dict(trial.columns[0])

    def fields(self, p, fields, at, xp):
        """The nearer of two ends, on the side on which the stop is."""
        ranges, limited, position = fields["jnt_range"], fields["jnt_limited"] > 0, p["position"][..., None]
        here = onehot(limited.shape[-1], at.joint) > 0
        low, high = xp.where(limited, ranges[..., 0], -FAR), xp.where(limited, ranges[..., 1], FAR)
        upper = position > 0.5 * (at.reach[0] + at.reach[1])
        low = xp.where(upper, low, xp.maximum(low, position))
        high = xp.where(upper, xp.minimum(high, position), high)
        changed = xp.where(here[:, None], xp.stack([low, high], -1), ranges)
        return {"jnt_range": changed, "jnt_limited": limited | here}
