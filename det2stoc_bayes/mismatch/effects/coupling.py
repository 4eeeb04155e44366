"""A joint that follows another one."""

from dataclasses import replace

from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, around, normal
from det2stoc_bayes.mismatch.effects.joint import JointEffect

RATIOS = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)  # that are tried first
LEAST = 1e-3  # of the typical stiffness and damping, from which a fit may start


class Coupling(JointEffect):
    """A spring and a damper hold the joint to ratio times its source, on which they act back."""

    name, law_text, noun = "coupling", "-k (q - ratio q_source) - c (v - ratio v_source)", "A coupling"
    law = r"-k\,(q - \rho\,q_s) - c\,(v - \rho\,v_s)"
    parameters = (
        EffectParameter("ratio", "1"),
        EffectParameter("stiffness", ("N/m", "N m/rad")),
        EffectParameter("damping", ("N s/m", "N m s/rad")),
    )
    complexity = 3

    def places(self, element, others):
        """Held to each of the other joints."""
        return tuple(
            replace(element, source=e.name, source_dof=e.dof, source_qpos=e.qpos)
            for e in others
            if e.dof != element.dof
        )

    def priors(self, typical):
        """Forces of about the typical size over the travel, at the typical speed, or much larger ones."""
        stiffness, damping = typical.force / typical.span, typical.force / typical.speed
        return {"ratio": normal(1.5), "stiffness": around(stiffness, 2.0), "damping": around(0.3 * damping, 2.0)}

    def trials(self, typical):
        """A few ratios, each with a spring's and a damper's column."""
        k, c = 0.01 * typical.force / typical.span, 0.01 * typical.force / typical.speed
        none = {"stiffness": 0.0, "damping": 0.0}
        return [Trial(({**none, "ratio": r, "stiffness": k}, {**none, "ratio": r, "damping": c})) for r in RATIOS]

    def combine(self, trial, coefficients, typical):
        """Both as fitted, if positive."""
        first, second = trial.columns
        k, c = 100 * first["stiffness"], 100 * second["damping"]
        return {
            "ratio": first["ratio"],
            "stiffness": max(0.01 * k * float(coefficients[0]), LEAST * k),
            "damping": max(0.01 * c * float(coefficients[1]), LEAST * c),
        }

    def joint_force(self, p, s, xp):
        """On the joint."""
        return pull(p, s, s.source)

    def reaction(self, p, s, xp):
        """On its source: no work is lost but the damper's."""
        return -p["ratio"] * pull(p, s, s.source)


def pull(p, here, there):
    """Of the spring and the damper."""
    apart, faster = here.q - p["ratio"] * there.q, here.v - p["ratio"] * there.v
    return -p["stiffness"] * apart - p["damping"] * faster
