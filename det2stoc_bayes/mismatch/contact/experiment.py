"""Which further recording would tell two explanations apart where bodies touch, and predictions are no guide.

Each effect shows in a motion of its own; the motions of the two most probable ones are what is to be recorded.
"""

from collections.abc import Sequence

from det2stoc_bayes.mismatch.finding import Alternative
from det2stoc_bayes.mismatch.statements import word

MOTIONS = {
    "friction_error": "slides of several speeds until rest, without turning",
    "rolling_friction": "rolling until rest, without sliding",
    "torsional_friction": "turning on the spot until rest",
    "contact_stiffness": "long rests under more and less weight",
    "restitution_error": "drops from several heights",
    "adhesion": "slides and slow lifts under more and less weight",
    "viscous_contact_friction": "slides of several speeds that begin fast",
    "anisotropic_friction": "slides in many directions over one place",
    "friction_patch": "slides over several places, each of them in two directions",
    "linear_drag": "slow flights that touch nothing",
    "quadratic_drag": "flights at several high speeds that touch nothing",
    "magnus_lift": "flights that touch nothing, with and without spin",
    "buoyancy": "falls from rest that touch nothing",
    "added_mass": "pushes in free motion by several known forces",
    "tether": "motion far from where it begins, in several directions",
    "attraction": "rests and slow lifts at several distances",
    "payload_mass": "pushes by a known force, and tilts to several sides",
    "mass_error": "pushes by a known force",
    "com_offset": "tilts and drops on several sides",
    "inertia_error": "free spins about several axes",
    "gravity_tilt": "slides in opposite directions along each axis",
    "gravity_error": "falls that touch nothing",
    "steady_wind": "rests and slow flights in several directions",
    "viscous_damping": "motion that is several times slower and faster",
    "quadratic_damping": "motion that is several times faster",
    "coulomb_friction": "slow motion until rest",
    "joint_spring": "rests at several positions",
    "armature": "quick changes of speed",
}
OF_KIND = {
    "joint": "slow and fast motion in both directions",
    "body": "free motion that touches nothing",
    "world": "long free motion in several directions",
    "contact": "touches at several speeds and from several sides",
    "actuator": "steps of the command of several sizes",
    "sensor": "a rest, and then fast motion",
    "simulator": "the same again, sampled more often",
}


def proposed(candidates: Sequence[Alternative]) -> str:
    """What to record, in a sentence; candidates by probability, of which one at least."""
    first, *others = candidates
    other = next((c for c in others if (c.name, c.element) != (first.name, first.element)), None)
    if other is None:
        return f"Record {_motion(first)}: {_named(first)} shows there, if it is that."
    if other.name == first.name:
        return (
            f"Record {_motion(first)} in which {_where(first)} takes part and {_where(other)} does not, and the other "
            f"way round: {word(first)} shows in one of both."
        )
    here, there = (f"{_motion(c)}, where {_named(c)} would show" for c in (first, other))
    return f"Record {here}, and {there}: the error stays in one of both."


def _motion(c: Alternative) -> str:
    return MOTIONS.get(c.name) or OF_KIND[c.element.kind if c.element else "simulator"]


def _where(c: Alternative) -> str:
    if c.element is None:
        return "the simulator"
    label = c.element.label
    return f"the {label}" if label == c.element.name else label


def _named(c: Alternative) -> str:
    return f"{word(c)} on {_where(c)}"
