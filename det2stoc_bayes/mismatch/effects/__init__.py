"""The catalogue of effects: adding one is one class in one of these files and its line here."""

from det2stoc_bayes.mismatch.effects import (
    actuator,
    added_mass,
    base_vibration,
    body,
    buoyancy,
    friction,
    hard_stop,
    inertia,
    joint,
    periodic,
    sensor,
    simulator,
    world,
)
from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Element, PlacedEffect, Typical

CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        joint.ViscousDamping(),
        joint.CoulombFriction(),
        friction.StribeckFriction(),
        joint.QuadraticDamping(),
        friction.LoadDependentFriction(),
        joint.JointSpring(),
        joint.CubicStiffness(),
        joint.ConstantForce(),
        joint.Armature(),
        periodic.CoggingTorque(),
        periodic.PeriodicForce(),
        hard_stop.HardStop(),
        body.LinearDrag(),
        body.QuadraticDrag(),
        body.MagnusLift(),
        buoyancy.Buoyancy(),
        added_mass.AddedMass(),
        inertia.PayloadMass(),
        inertia.MassError(),
        inertia.ComOffset(),
        inertia.InertiaError(),
        world.GravityTilt(),
        world.GravityError(),
        world.SteadyWind(),
        periodic.PeriodicWind(),
        base_vibration.BaseVibration(),
        actuator.ActuatorDelay(),
        actuator.ActuatorLag(),
        actuator.ActuatorGain(),
        actuator.ActuatorBias(),
        actuator.ActuatorDeadZone(),
        actuator.ActuatorSaturation(),
        actuator.ActuatorGainDrift(),
        actuator.TorqueSpeedLimit(),
        sensor.SensorBias(),
        sensor.SensorScale(),
        sensor.SensorDelay(),
        sensor.SensorDrift(),
        sensor.ClockSkew(),
        simulator.NumericalIntegration(),
    )
}

__all__ = ["CATALOGUE", "Effect", "EffectParameter", "Element", "PlacedEffect", "Typical"]
