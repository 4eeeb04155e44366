"""Dry friction whose size depends on the motion or the load; it holds at rest, as MuJoCo's frictionloss does."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, around, normal, onehot
from det2stoc_bayes.mismatch.effects.elements import transmitted
from det2stoc_bayes.mismatch.effects.joint import JointEffect

FRACTIONS = (0.03, 0.1, 0.3, 0.8)  # of the typical speed, at which friction's peak may end


class DryFriction(JointEffect):
    """Friction whose size changes from step to step."""

    writes = ("dof_frictionloss",)

    def momentary(self, p, fields, s, at, xp):
        """Adds the present size to the frictionloss."""
        loss, more = fields["dof_frictionloss"], self.friction(p, s, xp)
        return {"dof_frictionloss": loss + more[..., None] * onehot(loss.shape[-1], at.dof)}


class StribeckFriction(DryFriction):
    """Dry friction that is larger near rest (`static`) than in motion (`coulomb`)."""

    name, law_text, noun = "stribeck_friction", "-(Fc + (Fs - Fc) exp(-(v/vs)^2)) sign(v)", "Stribeck friction"
    law = r"-\left(F_c + (F_s - F_c)\,e^{-(v/v_s)^2}\right)\operatorname{sign}(v)"
    parameters = (
        EffectParameter("coulomb", ("N", "N m"), positive=True),
        EffectParameter("static", ("N", "N m"), positive=True),
        EffectParameter("velocity", ("m/s", "rad/s"), positive=True),
    )
    complexity = 3

    def priors(self, typical):
        """A fraction of the forces that act on the joint; the peak ends below the typical speed."""
        force = normal(0.3 * typical.force)
        return {"coulomb": force, "static": force, "velocity": around(0.2 * typical.speed, 1.0)}

    def from_normal(self, z, typical, xp=np):
        """Friction in motion and what it has more at rest are independent."""
        moving, more = 0.3 * typical.force * z[0], 0.3 * typical.force * z[1]
        velocity = self.priors(typical)["velocity"].from_normal(z[2], xp)
        return {"coulomb": moving, "static": moving + more, "velocity": velocity}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        scale, velocity = 0.3 * typical.force, np.asarray(values["velocity"])
        more = values["static"] - values["coulomb"]
        return np.array(
            [values["coulomb"] / scale, more / scale, float(self.priors(typical)["velocity"].to_normal(velocity))]
        )

    def floor(self, typical):
        """Neither friction in motion nor what it has more at rest is negative."""
        return np.array([0.0, 0.0, -np.inf])

    def special_cases(self, values):
        """No peak."""
        return {"coulomb_friction": {"force": values["coulomb"]}}

    def trials(self, typical):
        """Friction of constant size and the peak at rest as two columns, for a few widths of the peak."""
        step = 0.003 * typical.force
        both, peak = {"coulomb": step, "static": step}, {"coulomb": 0.0, "static": step}
        return [
            Trial(tuple({**c, "velocity": f * typical.speed} for c in (both, peak)), one_sided=True) for f in FRACTIONS
        ]

    def combine(self, trial, coefficients, typical):
        """Sizes add; both stay above 0."""
        step = trial.columns[0]["coulomb"]
        moving = max(float(coefficients[0]), 0.0) * step
        peak = moving + max(float(coefficients[1]), 0.0) * step
        return {"coulomb": moving, "static": peak, "velocity": trial.columns[0]["velocity"]}

    def friction(self, p, s, xp):
        """Falls from the static size to the moving one."""
        return p["coulomb"] + (p["static"] - p["coulomb"]) * xp.exp(-((s.v / p["velocity"]) ** 2))


class LoadDependentFriction(DryFriction):
    """Dry friction that grows with the torque that the joint's own actuators transmit."""

    name, law_text, noun = "load_dependent_friction", "-mu abs(torque) sign(v)", "Load-dependent friction"
    law = r"-\mu\,|\tau|\operatorname{sign}(v)"
    parameters = (EffectParameter("coefficient", "1", positive=True),)
    needs = frozenset({"driven"})
    complexity = 2

    def priors(self, typical):
        """Gears lose some tenths of what they transmit."""
        return {"coefficient": normal(0.2)}

    def friction(self, p, s, xp):
        """Of the present torque."""
        return p["coefficient"] * xp.abs(transmitted(s.drive, s.q, s.v, xp))
