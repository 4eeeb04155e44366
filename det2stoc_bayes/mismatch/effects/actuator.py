"""Effects between a command and what arrives at the actuator."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter
from det2stoc_bayes.mismatch.effects.joint import normal
from det2stoc_bayes.priors import Prior


class ActuatorDelay(Effect):
    """The command arrives late; before the first command that first one is held."""

    name, kind, law, law_text = "actuator_delay", "actuator", r"u(t - \tau)", "u(t - delay)"
    parameters = (EffectParameter("delay", "s", positive=True),)

    def priors(self, typical):
        """Buses and drives take milliseconds to tens of milliseconds."""
        return {"delay": normal(0.03)}

    def memory(self, p):
        """The longest delay."""
        return float(np.max(p["delay"], initial=0.0))

    def control(self, p, u, dt, xp):
        """Linear between steps, so that the motion is continuous in the delay."""
        steps = xp.clip(p["delay"] / dt, 0.0, u.shape[-1] - 2)
        whole = xp.floor(steps)
        late = xp.arange(u.shape[-1]) - whole[..., None].astype(int)
        newer = xp.take_along_axis(u, xp.clip(late, 0, None), -1)
        older = xp.take_along_axis(u, xp.clip(late - 1, 0, None), -1)
        share = (steps - whole)[..., None]
        return (1 - share) * newer + share * older


class ActuatorGain(Effect):
    """The command arrives scaled."""

    name, kind, law, law_text = "actuator_gain", "actuator", r"\rho\,u", "ratio u"
    parameters = (EffectParameter("ratio", "1", absent=1.0),)

    def priors(self, typical):
        """Around 1."""
        return {"ratio": Prior("Normal", {"loc": 1.0, "scale": 0.3})}

    def control(self, p, u, dt, xp):
        """Scaled."""
        return p["ratio"][..., None] * u
