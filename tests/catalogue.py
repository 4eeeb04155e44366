"""Every effect of the catalogue in every form, with values that show on an arm of two joints in moving air."""

from dataclasses import replace

import mujoco
import numpy as np
from conftest import state_columns

from det2stoc_bayes.engines import elements
from det2stoc_bayes.mismatch.effects import CATALOGUE, Effect, PlacedEffect, Typical

AIR = '<option timestep="0.002" integrator="{}" gravity="0 0 -9.81" density="40" wind="1.5 0.4 -0.7"/>'
CURVE = (0.4 * np.sin(0.4 * np.arange(65)) + 0.2).tolist()
SURFACE = (0.4 * np.sin(0.6 * np.arange(24))[:, None] * np.cos(0.7 * np.arange(8)) + 0.2).ravel().tolist()
VALUES: dict[str, dict] = {
    "ViscousDamping": {"coefficient": 0.3},
    "CoulombFriction": {"force": 0.2},
    "StribeckFriction": {"coulomb": 0.15, "static": 0.4, "velocity": 0.6},
    "QuadraticDamping": {"coefficient": 0.4},
    "LoadDependentFriction": {"coefficient": 0.12},
    "JointSpring": {"stiffness": 2.0, "rest": 0.3},
    "CubicStiffness": {"stiffness": 30.0},
    "ConstantForce": {"force": 0.7},
    "Armature": {"inertia": 0.05},
    "CoggingTorque": {"amplitude": 0.3, "cycles": 9.0, "phase": 0.4},
    "PeriodicForce": {"amplitude": 0.4, "frequency": 2.5, "phase": 0.4},
    "Backlash": {"gap": 0.1},
    "Hysteresis": {"force": 0.3, "stiffness": 6.0},
    "Coupling": {"ratio": 0.8, "stiffness": 4.0, "damping": 0.1},
    "HardStop": {"position": 0.05},
    "LinearDrag": {"coefficient": 0.6},
    "QuadraticDrag": {"coefficient": 0.6},
    "SizedDrag": {"drag_coefficient": 20.0},
    "MagnusLift": {"coefficient": 1.5},
    "Buoyancy": {"volume": 0.004},
    "AddedMass": {"mass": 0.2},
    "Tether": {"stiffness": 20.0, "length": 0.3, "anchor": [0.2, 0.1, 0.6]},
    "Attraction": {"strength": 0.3, "centre": [0.9, 0.2, 0.4]},
    "PayloadMass": {"mass": 0.2, "offset": [0.2, 0.05, -0.1]},
    "MassError": {"mass": -0.15},
    "ComOffset": {"offset": [0.03, 0.01, -0.02]},
    "InertiaError": {"ratio": [1.42, 1.4, 1.2]},
    "GravityTilt": {"toward_x": 0.1, "toward_y": -0.05},
    "GravityError": {"change": -0.5},
    "SteadyWind": {"velocity": [2.0, -0.5, 1.0]},
    "PeriodicWind": {"amplitude": 0.8, "frequency": 1.5, "phase": 0.7},
    "RotatingFrame": {"rate": [0.4, 0.7, -1.2]},
    "BaseVibration": {"amplitude": [0.01, 0.004, -0.02], "frequency": 3.0, "phase": 0.7},
    "ActuatorDelay": {"delay": 0.0333},
    "ActuatorLag": {"time_constant": 0.0333},
    "ActuatorGain": {"ratio": 1.7},
    "ActuatorBias": {"offset": 0.2},
    "ActuatorDeadZone": {"width": 0.15},
    "ActuatorSaturation": {"limit": 0.35},
    "ActuatorGainDrift": {"rate": 0.6},
    "TorqueSpeedLimit": {"stall": 0.9, "no_load_speed": 3.0},
    "SensorBias": {"offset": 0.1},
    "SensorScale": {"ratio": 1.1},
    "SensorDelay": {"delay": 0.0253},
    "SensorDrift": {"rate": 0.3},
    "ClockSkew": {"ratio": 1.03},
    "OverPosition": {"curve": CURVE, "least": -1.2, "most": 0.9},
    "OverVelocity": {"curve": CURVE, "least": -3.0, "most": 2.0},
    "OverTime": {"curve": CURVE, "least": 0.0, "most": 0.5},
    "OverCommand": {"curve": CURVE, "least": -0.6, "most": 1.2},
    "OverPositionAndVelocity": {"curve": SURFACE, "least": [-1.2, -3.0], "most": [0.9, 2.0]},
    "OverTimeAndVelocity": {"curve": SURFACE, "least": [0.0, -3.0], "most": [0.5, 2.0]},
    "OverTimeAndPosition": {"curve": SURFACE, "least": [0.0, -1.2], "most": [0.5, 0.9]},
}
APART = ("simulator", "contact")  # what no arm has
FORMS: dict[str, Effect] = {type(f).__name__: f for e in CATALOGUE.values() for f in e.forms() if e.kind not in APART}


def place_form(model: mujoco.MjModel, form: str, typical: Typical | None = None) -> PlacedEffect:
    """The form on the last element of the model that it fits."""
    effect, every = FORMS[form], frozenset(range(model.nbody))
    found = {
        "joint": lambda: elements.joint_elements(model),
        "body": lambda: elements.body_elements(model, every if "sized" in effect.needs else frozenset()),
        "actuator": lambda: elements.actuator_elements(model),
        "world": lambda: elements.world_elements(model),
        "sensor": lambda: elements.sensor_elements(model, tuple(state_columns(model))),
    }[effect.kind]()
    if effect.needs == {"loose"}:  # whatever MuJoCo took for granted when this test's model was compiled
        found = [replace(e, traits=e.traits | {"loose"}) for e in found]
    element = effect.places([e for e in found if effect.fits(e)][-1], found)[0]
    return PlacedEffect(effect, element, Typical() if typical is None else typical)
