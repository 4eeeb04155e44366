"""The catalogue of effects: adding one is one class in one of these files and its line here."""

from det2stoc_bayes.mismatch.effects.actuator import ActuatorDelay, ActuatorGain
from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Element, PlacedEffect, Typical
from det2stoc_bayes.mismatch.effects.body import QuadraticDrag
from det2stoc_bayes.mismatch.effects.joint import (
    Armature,
    CoggingTorque,
    ConstantForce,
    CoulombFriction,
    CubicStiffness,
    JointSpring,
    QuadraticDamping,
    ViscousDamping,
)
from det2stoc_bayes.mismatch.effects.sensor import SensorBias
from det2stoc_bayes.mismatch.effects.simulator import NumericalIntegration

CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        ViscousDamping(),
        CoulombFriction(),
        QuadraticDamping(),
        JointSpring(),
        CubicStiffness(),
        ConstantForce(),
        Armature(),
        CoggingTorque(),
        QuadraticDrag(),
        ActuatorDelay(),
        ActuatorGain(),
        SensorBias(),
        NumericalIntegration(),
    )
}

__all__ = ["CATALOGUE", "Effect", "EffectParameter", "Element", "PlacedEffect", "Typical"]
