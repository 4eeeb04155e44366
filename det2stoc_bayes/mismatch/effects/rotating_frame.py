"""A frame that turns: what is told relative to it feels Coriolis and centrifugal forces."""

from dataclasses import replace
from itertools import product

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Trial, normal, unit_columns
from det2stoc_bayes.mismatch.effects.vectors import cross, times

FULL = 2.0  # prior scale of a coefficient whose column stands at full size
SIZES = (0.3, 1.0)  # of the prior scale, at which the centrifugal force is looked at
AXES = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)


class RotatingFrame(Effect):
    """The world turns about its origin; gravity stays with it."""

    name, kind, noun = "rotating_frame", "world", "A turning of the frame"
    law = r"-2m\,\boldsymbol\Omega\times\mathbf v - m\,\boldsymbol\Omega\times(\boldsymbol\Omega\times\mathbf x)"
    law_text = "-2 m W x v - m W x (W x r)"
    parameters = (EffectParameter("rate", "rad/s", size=3),)
    complexity = 2

    def priors(self, typical):
        """A turn in some seconds."""
        return {"rate": normal(1.0)}

    def trials(self, typical):
        """Slow, where the Coriolis force is alone; and fast, where the centrifugal force mixes an axis's components."""
        fast = [tuple(size * axis) for axis in AXES for size in SIZES]
        return [
            Trial(unit_columns(self.parameters[0], 0.01)),
            *[Trial(({"rate": f},), FULL, one_sided=True) for f in fast],
        ]

    def about(self, trial, typical, reach):
        """Axes and speeds about a fast trial's."""
        fast = [np.asarray(values["rate"]) for values in trial.columns if len(trial.columns) == 1]
        steps = [(rate, reach * float(np.linalg.norm(rate))) for rate in fast]
        return [replace(trial, columns=({"rate": tuple(r + step * axis)},)) for r, step in steps for axis in AXES]

    def combine(self, trial, coefficients, typical):
        """Slow rates add up; a fast one's square is in proportion."""
        if len(trial.columns) == 1:
            return {"rate": np.asarray(trial.columns[0]["rate"]) * np.sqrt(max(float(coefficients[0]), 0.0))}
        return {"rate": 0.01 * np.asarray(coefficients, float)}

    def body_force(self, p, s, xp):
        """On the centre of mass."""
        rate = p["rate"]
        felt = cross(rate, 2 * s.velocity + cross(rate, s.position, xp), xp)
        return -s.mass[..., None] * felt

    def body_torque(self, p, s, xp):
        """About it: what its own spin and the frame's make of its inertia."""
        rate, spin = p["rate"], s.spin
        turned = times(s.inertia, cross(spin, rate, xp)) - cross(rate, times(s.inertia, rate + spin), xp)
        return turned - cross(spin, times(s.inertia, rate), xp)
