"""Commands as the actuators get them in time: held from sample to sample, late, or filtered to first order."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.blind.laws.base import Effect


class Signals:
    """Commands over time. They are smooth between consecutive `edges`, which hold the `stops` too.

    Before the first sample the command is the first one.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        effects: Sequence[Effect],
        times: Float[np.ndarray, " samples"],
        commands: Float[np.ndarray, "samples ctrl"],
        stops: Float[np.ndarray, " stops"],
    ) -> None:
        delay, constant = np.zeros(model.nu), np.zeros(model.nu)
        for effect in effects:
            if effect.name == "actuator_delay":
                delay[model.actuator(effect.element).id] += effect.parameters["delay"]
            elif effect.name == "actuator_lag":
                constant[model.actuator(effect.element).id] = effect.parameters["time_constant"]
        late = [times + d for d in delay[delay > 0.0]]
        edges = np.concatenate([stops, times, *late])
        edges = np.unique(edges[(edges >= stops.min()) & (edges <= stops.max())])
        self.edges = edges[np.concatenate(([True], np.diff(edges) > 1e-9))]
        middles = np.append(0.5 * (self.edges[:-1] + self.edges[1:]), self.edges[-1] + 1e-9)
        self._held = np.empty((middles.size, model.nu))
        for a in range(model.nu):
            source = np.searchsorted(times, middles - delay[a], side="right") - 1
            self._held[:, a] = commands[np.maximum(source, 0), a]
        self._lagged = np.flatnonzero(constant > 0.0)
        self._constant = constant[self._lagged]
        self._first = self._held[:, self._lagged].copy()
        for piece, duration in enumerate(np.diff(self.edges)):
            goal = self._held[piece, self._lagged]
            self._first[piece + 1] = goal + (self._first[piece] - goal) * np.exp(-duration / self._constant)

    def at(self, piece: int, t: float) -> np.ndarray:
        """The commands at a time in the piece that follows edge `piece`; called at every stage, so unchecked."""
        u = self._held[piece].copy()
        if self._lagged.size:
            goal = u[self._lagged]
            fading = np.exp(-(t - self.edges[piece]) / self._constant)
            u[self._lagged] = goal + (self._first[piece] - goal) * fading
        return u
