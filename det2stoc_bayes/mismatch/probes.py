"""Effects of which a unit is put on, to learn what a simulation makes of it."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Element, PlacedEffect, Typical


def unit(name: str, dof: int) -> PlacedEffect:
    """An effect of a joint's, by name, on one degree of freedom."""
    from det2stoc_bayes.mismatch.effects import CATALOGUE

    return PlacedEffect(CATALOGUE[name], Element("joint", f"dof {dof}", dof=dof, qpos=0), Typical())


def unit_command(at: Element) -> PlacedEffect:
    """A constant that is added to an actuator's command."""
    from det2stoc_bayes.mismatch.effects import CATALOGUE

    return PlacedEffect(CATALOGUE["actuator_bias"], at, Typical())


def gravity_probe() -> PlacedEffect:
    """A change of gravity's vector."""
    from det2stoc_bayes.mismatch.effects.base_vibration import GravityChange

    return PlacedEffect(GravityChange(), Element("world", "world"), Typical())


def grown(part: float) -> dict[str, float]:
    """Parameters of a periodic wind that has grown by this part of itself, and stays so."""
    return {"amplitude": part, "frequency": 0.0, "phase": 0.5 * np.pi}
