"""Effects of which a unit is put on, to learn what a simulation makes of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Element, PlacedEffect, Typical


@dataclass(frozen=True, eq=False)
class Probe:
    """An effect, under a key by which what is learnt is kept, and its parameters at some units of it."""

    key: tuple[str, int]
    placed: PlacedEffect
    values: Callable[[float], Mapping[str, Any]]


def of_joint(kind: str, name: str, dof: int) -> Probe:
    """An effect of a joint's, by name, on one degree of freedom."""
    return _sized(kind, dof, name, Element("joint", f"dof {dof}", dof=dof, qpos=0))


def of_command(at: Element) -> Probe:
    """A constant that is added to an actuator's command."""
    return _sized("ctrl", at.ctrl, "actuator_bias", at)


def of_gravity(axis: int) -> Probe:
    """Gravity that grows along an axis, m/s2."""
    from det2stoc_bayes.mismatch.effects.base_vibration import GravityChange

    placed = PlacedEffect(GravityChange(), Element("world", "world"), Typical())
    return Probe(("gravity", axis), placed, lambda size: {"change": size * np.eye(3)[axis]})


def of_wind(periodic: PlacedEffect) -> Probe:
    """A periodic wind that has grown by some of itself, and stays so."""
    return Probe(("wind", 0), periodic, lambda part: {"amplitude": part, "frequency": 0.0, "phase": 0.5 * np.pi})


def _sized(kind: str, number: int, name: str, at: Element) -> Probe:
    """A listed effect by its first parameter."""
    from det2stoc_bayes.mismatch.effects import CATALOGUE

    effect = CATALOGUE[name]
    first = effect.parameters[0].name
    return Probe((kind, number), PlacedEffect(effect, at, Typical()), lambda size: {first: size})
