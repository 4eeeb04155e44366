"""The believed systems by name, one module each."""

from det2stoc_bayes.blind.systems import (
    arm,
    ball,
    cart_pole,
    furuta,
    lift_arm,
    pan_tilt,
    pendulum,
    servo_arm,
    slider,
    torsion,
)
from det2stoc_bayes.blind.systems.base import Psi, System

_MODULES = (cart_pole, pendulum, arm, slider, servo_arm, ball, lift_arm, furuta, torsion, pan_tilt)
SYSTEMS: dict[str, System] = {module.SYSTEM.name: module.SYSTEM for module in _MODULES}

__all__ = ["SYSTEMS", "Psi", "System"]
