"""Effects between the truth and what is recorded."""

from det2stoc_bayes.mismatch.effects.base import COLUMN_UNIT, Effect, EffectParameter
from det2stoc_bayes.mismatch.effects.joint import normal


class SensorBias(Effect):
    """A column is off by a constant."""

    name, kind, law, law_text = "sensor_bias", "sensor", r"y + b", "y + offset"
    parameters = (EffectParameter("offset", COLUMN_UNIT),)

    def priors(self, typical):
        """A fraction of the column's range."""
        return {"offset": normal(0.05 * typical.span)}

    def reading(self, p, t, value, xp):
        """Shifted."""
        return value + p["offset"][..., None]
