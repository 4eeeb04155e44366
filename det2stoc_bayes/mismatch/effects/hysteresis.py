"""Dry friction that gives way elastically before it slips."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, around, normal
from det2stoc_bayes.mismatch.effects.joint import JointEffect

WAYS = (0.01, 0.04, 0.12, 0.4)  # of the typical travel, by which it gives way


class Hysteresis(JointEffect):
    """A spring whose other end slips once the force is reached (Jenkins' element); at a start it is at rest."""

    name, law_text, noun = "hysteresis", "-k z, z follows q within abs(k z) <= F", "Hysteresis"
    law = r"-k\,z,\ \dot z = \dot q \text{ while } |k z| \le F"
    parameters = (
        EffectParameter("force", ("N", "N m"), positive=True),
        EffectParameter("stiffness", ("N/m", "N m/rad"), absent=1.0),
    )
    complexity = 2

    def priors(self, typical):
        """A fraction of the typical force, within a fraction of the travel."""
        stiffness = 0.3 * typical.force / (0.1 * typical.span)
        return {"force": normal(0.3 * typical.force), "stiffness": around(stiffness, 1.5)}

    def from_normal(self, z, typical, xp=np):
        """The force and the way within which it builds up are independent."""
        force = 0.3 * typical.force * z[0]
        way = 0.1 * typical.span * xp.exp(1.5 * z[1])
        return {"force": force, "stiffness": xp.maximum(force, 1e-9 * typical.force) / way}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        way = np.maximum(values["force"], 1e-9 * typical.force) / values["stiffness"]
        return np.array([values["force"] / (0.3 * typical.force), np.log(way / (0.1 * typical.span)) / 1.5])

    def trials(self, typical):
        """A small force that builds up within a few ways."""
        force = 0.003 * typical.force
        return [Trial(({"force": force, "stiffness": force / (f * typical.span)},)) for f in WAYS]

    def combine(self, trial, coefficients, typical):
        """Force and stiffness grow together."""
        return {name: value * float(coefficients[0]) for name, value in trial.columns[0].items()}

    def anchor(self, p, q, anchor, xp):
        """Where the spring's other end is, given where it was."""
        way = p["force"] / p["stiffness"]
        return xp.clip(anchor, q - way, q + way)

    def joint_force(self, p, s, xp):
        """The spring's."""
        return -p["stiffness"] * (s.q - s.anchor)

    def force_along(self, p, s):
        """Along a trajectory whose points are on the last two axes, one after the other."""
        q, force = s.q.reshape(len(s.q), -1), np.empty((len(s.q), s.q[0].size))
        anchor = q[:, 0]
        for k in range(q.shape[1]):
            anchor = self.anchor(p, q[:, k], anchor, np)
            force[:, k] = -p["stiffness"] * (q[:, k] - anchor)
        return force.reshape(s.q.shape)
