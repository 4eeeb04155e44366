"""Effects between the truth and what is recorded."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import COLUMN_UNIT, SMALL, Effect, EffectParameter, Trial, normal
from det2stoc_bayes.priors import Prior

PERCENTS, MOST_OFF = 0.015, 2.0  # of the logarithm of a clock's ratio: its usual size, and the most that is simulated


class SensorEffect(Effect):
    """An effect on one recorded column."""

    kind, needs = "sensor", frozenset({"value"})


class SensorBias(SensorEffect):
    """A column is off by a constant."""

    name, law, law_text, noun = "sensor_bias", r"y + b", "y + offset", "An offset"
    parameters = (EffectParameter("offset", COLUMN_UNIT),)

    def priors(self, typical):
        """A fraction of the column's range."""
        return {"offset": normal(0.05 * typical.span)}

    def reading(self, p, t, value, xp):
        """Shifted."""
        return value + p["offset"][..., None]


class SensorScale(SensorEffect):
    """A column is scaled."""

    name, law, law_text, noun = "sensor_scale", r"\rho\,y", "ratio y", "A scale"
    parameters = (EffectParameter("ratio", "1", absent=1.0),)
    complexity = 2

    def priors(self, typical):
        """Around 1."""
        return {"ratio": Prior("Normal", {"loc": 1.0, "scale": 0.1})}

    def reading(self, p, t, value, xp):
        """Scaled about its zero."""
        return p["ratio"][..., None] * value


class SensorDelay(SensorEffect):
    """A column shows what was a while ago."""

    name, law, law_text, noun = "sensor_delay", r"y(t - \tau)", "y(t - delay)", "A delay"
    parameters = (EffectParameter("delay", "s", positive=True),)
    complexity = 2

    def priors(self, typical):
        """Filters and buses take milliseconds to tens of milliseconds."""
        return {"delay": normal(0.03)}

    def sample_time(self, p, t, xp):
        """Earlier."""
        return t - p["delay"][..., None]


class SensorDrift(SensorEffect):
    """A column's zero moves with time."""

    name, law, law_text, noun = "sensor_drift", r"y + r\,t", "y + rate t", "A drift"
    parameters = (EffectParameter("rate", COLUMN_UNIT + " per s"),)
    complexity = 2

    def priors(self, typical):
        """Over a recording a fraction of the column's range."""
        return {"rate": normal(0.05 * typical.span / typical.duration)}

    def reading(self, p, t, value, xp):
        """Off by what has gathered since time 0."""
        return value + p["rate"][..., None] * t


class ClockSkew(Effect):
    """The recording's clock, which stamps samples and commands alike, runs at `ratio` times true time."""

    name, kind, needs = "clock_skew", "sensor", frozenset({"clock"})
    law, law_text, noun = r"t_{\text{recorded}} = \rho\,t", "time = ratio t", "A clock's skew"
    parameters = (EffectParameter("ratio", "1", absent=1.0),)
    changes = ("opt.timestep",)
    complexity = 2

    def priors(self, typical):
        """Of its logarithm: software's timers are off by a percent or two, but a log's rate may be wrong by far."""
        return {"ratio": Prior("StudentT", {"df": 4.0, "loc": 0.0, "scale": PERCENTS})}

    def from_normal(self, z, typical, xp=np):
        """By its logarithm."""
        log_ratio = super().from_normal(z, typical, xp)["ratio"]
        return {"ratio": xp.exp(xp.clip(log_ratio, -MOST_OFF, MOST_OFF))}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        return super().to_normal({"ratio": np.log(np.maximum(values["ratio"], np.exp(-MOST_OFF)))}, typical)

    def trials(self, typical):
        """A little; the sd of what it may be times as large is as wide as the prior's far end asks."""
        return [Trial(({"ratio": 1.0 + SMALL * PERCENTS},), sd=3.0 / SMALL)]

    def fields(self, p, fields, at, xp):
        """A step of the recorded clock is one of true time over the ratio."""
        return {"opt.timestep": fields["opt.timestep"] / p["ratio"]}
