"""The believed systems by name, one module each."""

from det2stoc_bayes.blind.systems import (
    arm,
    ball,
    cart_pole,
    furuta,
    lift_arm,
    pan_tilt,
    pendulum,
    puck,
    servo_arm,
    slider,
    slope_box,
    thrown_box,
    torsion,
)
from det2stoc_bayes.blind.systems.base import Psi, System

_MODULES = (cart_pole, pendulum, arm, slider, servo_arm, ball, lift_arm, furuta, torsion, pan_tilt)
_TOUCHING = (slope_box, puck, thrown_box)
SMOOTH: tuple[str, ...] = tuple(module.SYSTEM.name for module in _MODULES)  # nothing touches
SYSTEMS: dict[str, System] = {module.SYSTEM.name: module.SYSTEM for module in (*_MODULES, *_TOUCHING)}

__all__ = ["SMOOTH", "SYSTEMS", "Psi", "System"]
