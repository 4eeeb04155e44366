"""A base that shakes: everything on it feels the acceleration that it has itself."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Trial, normal
from det2stoc_bayes.mismatch.effects.periodic import ladder, timed_rates
from det2stoc_bayes.priors import Prior

WIDE = 2.0  # rad, a phase's prior scale: a negative amplitude is the phase on the other side


class BaseVibration(Effect):
    """The world moves by amplitude sin(2 pi f t + phase); positions are told relative to it."""

    name, kind, noun = "base_vibration", "world", "A vibration of the base"
    law, law_text = r"\mathbf A\,\sin(2\pi f t + \varphi)", "base at A sin(2 pi f t + phase)"
    parameters = (
        EffectParameter("amplitude", "m", size=3),
        EffectParameter("frequency", "Hz"),
        EffectParameter("phase", "rad"),
    )
    writes = ("opt.gravity",)
    complexity = 4

    def priors(self, typical):
        """Accelerations of a tenth of gravity; frequency log-uniform; phase uniform."""
        low, high, pitch = timed_rates(typical)
        return {
            "amplitude": normal(acceleration(typical) / (2 * np.pi * np.sqrt(low * high)) ** 2),
            "frequency": Prior("LogUniform", {"low": low, "high": high}),
            "phase": Prior("Uniform", {"low": -np.pi, "high": np.pi}),
        }

    def from_normal(self, z, typical, xp=np):
        """Accelerations are normal, whatever the frequency; the phase is an angle without a seam of its own."""
        frequency = self.priors(typical)["frequency"].from_normal(z[3], xp)
        size = acceleration(typical) / (2 * xp.pi * frequency) ** 2
        return {
            "amplitude": xp.stack([size * z[i] for i in range(3)], -1),
            "frequency": frequency,
            "phase": WIDE * z[4],
        }

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        frequency = np.asarray(values["frequency"])
        size = acceleration(typical) / (2 * np.pi * frequency) ** 2
        z = float(self.priors(typical)["frequency"].to_normal(frequency))
        return np.array([*(np.asarray(values["amplitude"]) / size), z, float(values["phase"]) / WIDE])

    def trials(self, typical):
        """A sine and a cosine column along each axis for each of a ladder of frequencies."""
        low, high, pitch = timed_rates(typical)
        return [
            Trial(
                tuple(
                    {"amplitude": tuple(axis * 0.01 * acceleration(typical) / (2 * np.pi * f) ** 2), "frequency": f}
                    | {"phase": shift}
                    for axis in np.eye(3)
                    for shift in (0.0, np.pi / 2)
                )
            )
            for f in ladder(low, high, pitch)
        ]

    def combine(self, trial, coefficients, typical):
        """The amplitude along each axis at the phase that most of the motion has."""
        parts = np.asarray(coefficients).reshape(3, 2)
        phasors = parts[:, 0] + 1j * parts[:, 1]
        phase = 0.5 * float(np.angle(np.sum(phasors**2)))
        size = max(abs(float(x)) for x in trial.columns[0]["amplitude"])
        along = size * (phasors * np.exp(-1j * phase)).real
        return {"amplitude": along, "frequency": trial.columns[0]["frequency"], "phase": phase}

    def gravity(self, p, t, xp):
        """What is felt: minus the base's acceleration."""
        rate = 2 * xp.pi * p["frequency"]
        return p["amplitude"] * (rate**2 * xp.sin(rate * t + p["phase"]))[..., None]

    def momentary(self, p, fields, s, at, xp):
        """Added to gravity."""
        return {"opt.gravity": fields["opt.gravity"] + self.gravity(p, s.t, xp)}


class GravityChange(Effect):
    """A change of gravity's vector; not of the catalogue, but what screening probes with."""

    name, kind, law, law_text = "gravity_change", "world", r"\mathbf g + \mathbf a", "g + change"
    parameters = (EffectParameter("change", "m/s2", size=3),)
    changes = ("opt.gravity",)

    def fields(self, p, fields, at, xp):
        """Added to gravity."""
        return {"opt.gravity": fields["opt.gravity"] + p["change"]}


def acceleration(typical):
    """A tenth of gravity, of 1 m/s2 at least."""
    return max(0.1 * typical.force, 0.1)
