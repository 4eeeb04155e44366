"""What of a prediction's change its windows' own starts cannot make up for: least squares beside a start a window.

Each window's start is known as well as its first sample. What a hypothesis changes in a window is in part what another
start would change, and is no sign of it; and where unknowns move, the starts move along. Both follow from the
sensitivities to the starts by linear algebra (the Schur complement of a bundle adjustment).
"""

from functools import cached_property

import numpy as np
from jaxtyping import Float


class BesideStarts:
    """Weighted least squares in each window beside its start, whose unit is the sd of a recorded start.

    weights: of squared errors. slopes: of the prediction for one sd of each state of the start. away: where the start
    stands from the recorded one.
    """

    def __init__(
        self,
        weights: Float[np.ndarray, "windows horizons columns"],
        slopes: Float[np.ndarray, "windows horizons columns states"],
        away: Float[np.ndarray, "windows states"],
    ):
        self._roots = np.sqrt(weights.reshape(len(weights), -1))
        self._slopes, self._away = slopes.reshape(*self._roots.shape, -1), away

    @cached_property
    def _factors(self) -> tuple[Float[np.ndarray, "windows values states"], Float[np.ndarray, "windows states states"]]:
        states = self._away.shape[1]
        unit = np.broadcast_to(np.eye(states), (len(self._away), states, states))
        q, r = np.linalg.qr(np.concatenate([self._roots[..., None] * self._slopes, unit], 1))
        return q, r

    def columns(
        self, columns: Float[np.ndarray, "windows horizons columns size"]
    ) -> Float[np.ndarray, "windows values size"]:
        """Sensitivities in units of noise, less what the starts can make up for."""
        top = self._roots[..., None] * columns.reshape(*self._roots.shape, -1)
        nothing = np.zeros((len(top), self._away.shape[1], top.shape[2]))
        return self._left(np.concatenate([top, nothing], 1))

    def errors(self, errors: Float[np.ndarray, "windows horizons columns"]) -> Float[np.ndarray, "windows values"]:
        """Errors likewise, the start's own distance from the recorded one among them."""
        return self._left(self._stacked(errors)[..., None])[..., 0]

    def moves(self, errors: Float[np.ndarray, "windows horizons columns"]) -> Float[np.ndarray, "windows states"]:
        """The change of each start that explains these errors best."""
        q, r = self._factors
        return np.linalg.solve(r, (np.swapaxes(q, 1, 2) @ self._stacked(errors)[..., None]))[..., 0]

    def _stacked(self, errors: np.ndarray) -> np.ndarray:
        return np.concatenate([self._roots * np.nan_to_num(errors).reshape(self._roots.shape), -self._away], 1)

    def _left(self, x: np.ndarray) -> np.ndarray:
        q, _ = self._factors
        return x - q @ (np.swapaxes(q, 1, 2) @ x)
