"""Effects on joints: forces along one degree of freedom."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Trial, normal, onehot


class JointEffect(Effect):
    """An effect on a hinge or slide joint."""

    kind = "joint"


class ViscousDamping(JointEffect):
    """Friction proportional to speed (MuJoCo's joint damping)."""

    name, law, law_text = "viscous_damping", r"-c\,v", "-c v"
    noun = "Viscous damping"
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
    noun = "Dry friction"
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
    noun = "Quadratic damping"
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
    noun = "A spring"
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
    noun = "A hardening spring"
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
    noun = "A constant force"
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
    noun = "Reflected inertia"
    parameters = (EffectParameter("inertia", ("kg", "kg m2"), positive=True),)
    changes = ("dof_armature",)

    def priors(self, typical):
        """A fraction of the joint's apparent inertia."""
        return {"inertia": normal(0.3 * typical.inertia)}

    def fields(self, p, fields, at, xp):
        """Adds to the joint's armature."""
        armature = fields["dof_armature"]
        return {"dof_armature": armature + p["inertia"][..., None] * onehot(armature.shape[-1], at.dof)}
