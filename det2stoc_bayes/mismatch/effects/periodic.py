"""What repeats, with position or with time: an amplitude, a rate and a phase."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Trial, normal
from det2stoc_bayes.mismatch.effects.joint import JointEffect
from det2stoc_bayes.priors import Prior

MOST_RATES = 240  # trials
LEAST_PERIODS = 0.75  # in a recording of what repeats with time: half a period stands for a constant
TINY = 1e-9


class SineEffect(Effect):
    """Amplitude times the sine of (rate times something, plus phase); the second parameter is the rate."""

    complexity = 3

    def _scale(self, typical):
        raise NotImplementedError

    def _rates(self, typical):
        """Lowest and highest rate, and how far apart two rates are that give unlike sines."""
        raise NotImplementedError

    def priors(self, typical):
        """Amplitude normal; rate log-uniform; phase uniform."""
        low, high, _ = self._rates(typical)
        amplitude, rate, phase = self.parameters
        return {
            amplitude.name: normal(self._scale(typical)),
            rate.name: Prior("LogUniform", {"low": low, "high": high}),
            phase.name: Prior("Uniform", {"low": -np.pi, "high": np.pi}),
        }

    def from_normal(self, z, typical, xp=np):
        """Sine and cosine parts are normal, so that the phase has no seam."""
        sine, cosine = self._scale(typical) * z[0], self._scale(typical) * z[1]
        amplitude, rate, phase = (p.name for p in self.parameters)
        value = self.priors(typical)[rate].from_normal(z[2], xp)
        return {amplitude: xp.hypot(sine, cosine), rate: value, phase: xp.arctan2(cosine, sine)}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        amplitude, rate, phase = (p.name for p in self.parameters)
        a = values[amplitude] / self._scale(typical)
        z = self.priors(typical)[rate].to_normal(np.asarray(values[rate]))
        return np.array([a * np.cos(values[phase]), a * np.sin(values[phase]), float(z)])

    def trials(self, typical):
        """A sine and a cosine column for each of a ladder of rates."""
        low, high, pitch = self._rates(typical)
        amplitude, rate, phase = (p.name for p in self.parameters)
        size = 0.01 * self._scale(typical)
        return [
            Trial(tuple({amplitude: size, rate: r, phase: shift} for shift in (0.0, np.pi / 2)))
            for r in ladder(low, high, pitch)
        ]

    def combine(self, trial, coefficients, typical):
        """Amplitude and phase from the sine and cosine coefficients."""
        amplitude, rate, phase = (p.name for p in self.parameters)
        unit = trial.columns[0]
        return {
            amplitude: unit[amplitude] * float(np.hypot(*coefficients)),
            rate: unit[rate],
            phase: float(np.arctan2(coefficients[1], coefficients[0])),
        }


def ladder(low, high, pitch):
    """Multiples of a pitch between two rates."""
    return pitch * np.arange(np.floor(low / pitch + TINY) + 1, np.ceil(high / pitch - TINY))


def timed_rates(typical):
    """From LEAST_PERIODS in the longest recording to half the sampling rate, at most MOST_RATES; and their pitch."""
    pitch = 0.5 / typical.duration
    return LEAST_PERIODS / typical.duration, min(max(0.5 / typical.sampling, 4 * pitch), MOST_RATES * pitch), pitch


class TimedEffect(SineEffect):
    """A sine of time."""

    def _rates(self, typical):
        """Frequencies."""
        return timed_rates(typical)


class CoggingTorque(JointEffect, SineEffect):
    """A ripple that repeats with position."""

    name, law, law_text = "cogging_torque", r"A\,\sin(n q + \varphi)", "A sin(n q + phase)"
    noun = "A torque ripple"
    parameters = (
        EffectParameter("amplitude", ("N", "N m")),
        EffectParameter("cycles", ("1/m", "1/rad")),
        EffectParameter("phase", "rad"),
    )

    def _scale(self, typical):
        """A fraction of the typical force."""
        return 0.2 * typical.force

    def _rates(self, typical):
        """From half a period to thirty over the typical travel: slower is a spring, faster is out of sight."""
        return np.pi / typical.span, 60 * np.pi / typical.span, np.pi / (2 * typical.span)

    def joint_force(self, p, s, xp):
        """A sine of position."""
        return p["amplitude"] * xp.sin(p["cycles"] * s.q + p["phase"])


class PeriodicForce(JointEffect, TimedEffect):
    """A force that repeats with time."""

    name, law, law_text = "periodic_force", r"A\,\sin(2\pi f t + \varphi)", "A sin(2 pi f t + phase)"
    noun = "A periodic force"
    parameters = (
        EffectParameter("amplitude", ("N", "N m")),
        EffectParameter("frequency", "Hz"),
        EffectParameter("phase", "rad"),
    )

    def _scale(self, typical):
        """A fraction of the typical force."""
        return 0.2 * typical.force

    def joint_force(self, p, s, xp):
        """A sine of time."""
        return p["amplitude"] * xp.sin(2 * xp.pi * p["frequency"] * s.t + p["phase"])


class PeriodicWind(TimedEffect):
    """A wind that swells and fades with time."""

    name, kind, needs = "periodic_wind", "world", frozenset({"fluid", "wind"})
    law, law_text = r"\mathbf w\,(1 + A\,\sin(2\pi f t + \varphi))", "wind (1 + A sin(2 pi f t + phase))"
    noun = "A periodic wind"
    parameters = (
        EffectParameter("amplitude", "1"),
        EffectParameter("frequency", "Hz"),
        EffectParameter("phase", "rad"),
    )
    writes = ("opt.wind",)

    def _scale(self, typical):
        """A fraction of the steady wind."""
        return 0.5

    def swell(self, p, t, xp):
        """A sine of time."""
        return p["amplitude"] * xp.sin(2 * xp.pi * p["frequency"] * t + p["phase"])

    def momentary(self, p, fields, s, at, xp):
        """The steady wind times a factor."""
        return {"opt.wind": fields["opt.wind"] * (1 + self.swell(p, s.t, xp))[..., None]}
