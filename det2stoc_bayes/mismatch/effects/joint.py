"""Effects on joints: forces along one degree of freedom."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Trial, onehot
from det2stoc_bayes.priors import Prior


def normal(scale: float) -> Prior:
    """A signed parameter of this size."""
    return Prior("Normal", {"loc": 0.0, "scale": scale})


class JointEffect(Effect):
    """An effect on a hinge or slide joint."""

    kind = "joint"


class ViscousDamping(JointEffect):
    """Friction proportional to speed (MuJoCo's joint damping)."""

    name, law, law_text = "viscous_damping", r"-c\,v", "-c v"
    parameters = (EffectParameter("coefficient", ("N s/m", "N m s/rad")),)
    changes = ("dof_damping",)

    def priors(self, typical):
        """Negative values stand for too much damping in the model."""
        return {"coefficient": normal(0.3 * typical.force / typical.speed)}

    def fields(self, p, fields, at, xp):
        """Adds to the joint's damping."""
        damping = fields["dof_damping"]
        return {"dof_damping": damping + p["coefficient"][..., None] * onehot(damping.shape[-1], at.dof)}


class CoulombFriction(JointEffect):
    """Dry friction of constant size, holding at rest (MuJoCo's frictionloss)."""

    name, law, law_text = "coulomb_friction", r"-F\,\operatorname{sign}(v)", "-F sign(v)"
    parameters = (EffectParameter("force", ("N", "N m"), positive=True),)
    changes = ("dof_frictionloss",)

    def priors(self, typical):
        """A fraction of the forces that act on the joint."""
        return {"force": normal(0.3 * typical.force)}

    def fields(self, p, fields, at, xp):
        """Adds to the joint's frictionloss."""
        loss = fields["dof_frictionloss"]
        return {"dof_frictionloss": loss + p["force"][..., None] * onehot(loss.shape[-1], at.dof)}


class QuadraticDamping(JointEffect):
    """Friction that grows with the square of speed (MuJoCo's polynomial damping)."""

    name, law, law_text = "quadratic_damping", r"-c\,|v|\,v", "-c abs(v) v"
    parameters = (EffectParameter("coefficient", ("N s2/m2", "N m s2/rad2"), positive=True),)
    changes = ("dof_dampingpoly",)
    in_mjx_fields = False

    def priors(self, typical):
        """At the typical speed a fraction of the typical force."""
        return {"coefficient": normal(0.3 * typical.force / typical.speed**2)}

    def fields(self, p, fields, at, xp):
        """Adds to the coefficient of abs(v) v."""
        poly = fields["dof_dampingpoly"]
        place = onehot(poly.shape[-2], at.dof)[:, None] * np.array([1.0, 0.0])
        return {"dof_dampingpoly": poly + p["coefficient"][..., None, None] * place}

    def joint_force(self, p, s, xp):
        """The same as a force, for an engine without the field."""
        return -p["coefficient"] * xp.abs(s.v) * s.v


class JointSpring(JointEffect):
    """A linear spring with its own rest position."""

    name, law, law_text = "joint_spring", r"-k\,(q - q_0)", "-k (q - rest)"
    parameters = (EffectParameter("stiffness", ("N/m", "N m/rad")), EffectParameter("rest", ("m", "rad")))
    complexity = 2

    def priors(self, typical):
        """A fraction of the typical force over the typical travel."""
        return {"stiffness": normal(0.3 * typical.force / typical.span), "rest": normal(typical.span)}

    def from_normal(self, z, typical, xp=np):
        """Stiffness and force at the origin are independent; the rest position is their ratio."""
        stiffness = 0.3 * typical.force / typical.span * z[0]
        safe = xp.where(xp.abs(stiffness) < 1e-12 * typical.force / typical.span, 1e-12, stiffness)
        return {"stiffness": stiffness, "rest": 0.3 * typical.force * z[1] / safe}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        scale = 0.3 * typical.force
        return np.array([values["stiffness"] * typical.span / scale, values["stiffness"] * values["rest"] / scale])

    def trials(self, typical):
        """The spring alone, then the spring with a rest position: two columns."""
        k = 0.003 * typical.force / typical.span
        return [
            Trial(({"stiffness": k, "rest": 0.0},)),
            Trial(({"stiffness": k, "rest": 0.0}, {"stiffness": k, "rest": typical.span})),
        ]

    def combine(self, trial, coefficients, typical):
        """The second column is the first plus a constant force."""
        k = trial.columns[0]["stiffness"]
        total = float(np.sum(coefficients)) * k
        offset = 0.0 if len(coefficients) == 1 else float(coefficients[1]) * k * typical.span
        return {"stiffness": total, "rest": offset / total if total else 0.0}

    def joint_force(self, p, s, xp):
        """Pulls towards the rest position."""
        return -p["stiffness"] * (s.q - p["rest"])


class CubicStiffness(JointEffect):
    """A spring that hardens with the cube of position."""

    name, law, law_text = "cubic_stiffness", r"-k\,q^3", "-k q^3"
    parameters = (EffectParameter("stiffness", ("N/m3", "N m/rad3")),)

    def priors(self, typical):
        """A fraction of the typical force at the typical travel."""
        return {"stiffness": normal(0.3 * typical.force / typical.span**3)}

    def joint_force(self, p, s, xp):
        """Cubic in position."""
        return -p["stiffness"] * s.q**3


class ConstantForce(JointEffect):
    """A force that is always there."""

    name, law, law_text = "constant_force", r"+F", "+F"
    parameters = (EffectParameter("force", ("N", "N m")),)

    def priors(self, typical):
        """A fraction of the typical force."""
        return {"force": normal(0.3 * typical.force)}

    def joint_force(self, p, s, xp):
        """Constant."""
        return p["force"] + 0.0 * s.v


class Armature(JointEffect):
    """Inertia reflected through the drive (MuJoCo's armature)."""

    name, law, law_text = "armature", r"-I\,\dot v", "-I dv/dt"
    parameters = (EffectParameter("inertia", ("kg", "kg m2"), positive=True),)
    changes = ("dof_armature",)

    def priors(self, typical):
        """A fraction of the joint's apparent inertia."""
        return {"inertia": normal(0.3 * typical.inertia)}

    def fields(self, p, fields, at, xp):
        """Adds to the joint's armature."""
        armature = fields["dof_armature"]
        return {"dof_armature": armature + p["inertia"][..., None] * onehot(armature.shape[-1], at.dof)}


class CoggingTorque(JointEffect):
    """A ripple that repeats with position."""

    name, law, law_text = "cogging_torque", r"A\,\sin(n q + \varphi)", "A sin(n q + phase)"
    parameters = (
        EffectParameter("amplitude", ("N", "N m")),
        EffectParameter("cycles", ("1/m", "1/rad")),
        EffectParameter("phase", "rad"),
    )
    complexity = 3

    def _cycle_range(self, typical):
        # From half a period to thirty over the typical travel: slower is a spring, faster is out of sight.
        return np.pi / typical.span, 60 * np.pi / typical.span

    def priors(self, typical):
        """Amplitude a fraction of the typical force; cycles log-uniform; phase uniform."""
        low, high = self._cycle_range(typical)
        return {
            "amplitude": normal(0.2 * typical.force),
            "cycles": Prior("LogUniform", {"low": low, "high": high}),
            "phase": Prior("Uniform", {"low": -np.pi, "high": np.pi}),
        }

    def from_normal(self, z, typical, xp=np):
        """Sine and cosine parts are normal, so that the phase has no seam."""
        sine, cosine = 0.2 * typical.force * z[0], 0.2 * typical.force * z[1]
        cycles = self.priors(typical)["cycles"].from_normal(z[2], xp)
        return {"amplitude": xp.hypot(sine, cosine), "cycles": cycles, "phase": xp.arctan2(cosine, sine)}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        a = values["amplitude"] / (0.2 * typical.force)
        cycles = self.priors(typical)["cycles"].to_normal(np.asarray(values["cycles"]))
        return np.array([a * np.cos(values["phase"]), a * np.sin(values["phase"]), float(cycles)])

    def trials(self, typical):
        """A sine and a cosine column for each of a ladder of spatial frequencies."""
        low, high = self._cycle_range(typical)
        amplitude = 0.002 * typical.force
        # Ripples n and n' decorrelate once (n' - n) span > pi / 2: a grid of that pitch, on whole cycles where dense.
        grid = np.unique(np.round(np.arange(low, high, np.pi / (2 * typical.span)), 6))
        return [
            Trial(
                (
                    {"amplitude": amplitude, "cycles": n, "phase": 0.0},
                    {"amplitude": amplitude, "cycles": n, "phase": np.pi / 2},
                )
            )
            for n in grid
        ]

    def combine(self, trial, coefficients, typical):
        """Amplitude and phase from the sine and cosine coefficients."""
        unit = trial.columns[0]
        return {
            "amplitude": unit["amplitude"] * float(np.hypot(*coefficients)),
            "cycles": unit["cycles"],
            "phase": float(np.arctan2(coefficients[1], coefficients[0])),
        }

    def joint_force(self, p, s, xp):
        """A sine of position."""
        return p["amplitude"] * xp.sin(p["cycles"] * s.q + p["phase"])
