"""An observer: a simulation that is led, sample by sample, towards what was recorded.

Where bodies touch, a long prediction is chaotic, and a start that is known no better than one sample is thrown out of
the floor. A simulated state that takes over a share of each sample's error stays near the recording and settles in its
contacts; by how much the next sample differs from what it foretells is the innovation of the prediction-error method
(Ljung, System Identification, 1999, ch. 7).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.engines.layout import integrate_positions
from det2stoc_bayes.engines.rotations import relative_rotation
from det2stoc_bayes.engines.state_columns import quaternion_address, state_columns

if TYPE_CHECKING:
    import mujoco

Gains = Float[np.ndarray, "segments samples nv 2 2"]  # corrections of (position, speed) by errors of (position, speed)


@dataclass(frozen=True, eq=False)
class Observer:
    """How simulated states follow the samples of their segments; `drawn`: values are errors of what is foretold."""

    gains: Gains
    values: Float[np.ndarray, "segments samples columns"]
    seen: Bool[np.ndarray, "segments samples nv 2"]
    drawn: bool = False


@dataclass(frozen=True, eq=False)
class ContactFlow:
    """What contact does to variances up to each sample, of a free mass': a floor holds a body, an impact jolts it."""

    kept: Float[np.ndarray, "segments samples nv 2"]  # share of (position, speed)
    grown: Float[np.ndarray, "segments samples nv"]  # added to the speed's, SI units squared


class Places:
    """Which columns are which coordinates of the state."""

    def __init__(self, model: "mujoco.MjModel", columns: Sequence[str]):
        self.model = model
        at = state_columns(model, tuple(columns))
        self.straight: list[tuple[int, int]] = []  # dof, column of its position
        self.turns: list[tuple[int, list[int]]] = []  # first dof, columns of the quaternion
        self.speeds = [(dof, at["qvel", dof]) for dof in range(model.nv) if ("qvel", dof) in at]
        for joint in range(model.njnt):
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            turn = quaternion_address(model, joint)
            count = 1 if turn is None else turn - q
            self.straight += [(v + k, at["qpos", q + k]) for k in range(count) if ("qpos", q + k) in at]
            if turn is not None and all(("qpos", turn + k) in at for k in range(4)):
                self.turns.append((v + count, [at["qpos", turn + k] for k in range(4)]))

    @cached_property
    def _apart(self) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """Coordinates whose errors are differences: the dof, position (0) or speed (1), and the column."""
        all_of = [(dof, 0, j) for dof, j in self.straight] + [(dof, 1, j) for dof, j in self.speeds]
        dofs, parts, places = np.array(all_of, int).reshape(-1, 3).T
        return dofs, parts, places

    def seen(self, observed: Bool[np.ndarray, "... columns"]) -> Bool[np.ndarray, "... nv 2"]:
        """Which coordinates (positions, speeds) samples show."""
        out = np.zeros((*observed.shape[:-1], self.model.nv, 2), bool)
        for dof, j in self.straight:
            out[..., dof, 0] = observed[..., j]
        for dof, group in self.turns:
            out[..., dof : dof + 3, 0] = observed[..., group].all(-1)[..., None]
        for dof, j in self.speeds:
            out[..., dof, 1] = observed[..., j]
        return out

    def noise(self, sd: Float[np.ndarray, " columns"]) -> Float[np.ndarray, "nv 2"]:
        """1 sd of each coordinate's noise, infinite where no column shows it; a component's s is an angle's 2 s."""
        out = np.full((self.model.nv, 2), np.inf)
        for dof, j in self.straight:
            out[dof, 0] = sd[j]
        for dof, group in self.turns:
            out[dof : dof + 3, 0] = 2 * sd[group].mean()
        for dof, j in self.speeds:
            out[dof, 1] = sd[j]
        return out

    def of_columns(
        self, spread: Float[np.ndarray, "... nv 2"], values: Float[np.ndarray, "... columns"]
    ) -> Float[np.ndarray, "... columns"]:
        """What is known of coordinates, for the columns that show them, as samples are; 1 for all others."""
        out = np.ones(values.shape)
        for dof, j in self.straight:
            out[..., j] = spread[..., dof, 0]
        for dof, group in self.turns:
            excess = spread[..., dof : dof + 3, 0] ** 2 - 1
            out[..., group] = np.sqrt(1 + np.einsum("...jk,...k->...j", _turned_share(values[..., group]), excess))
        for dof, j in self.speeds:
            out[..., j] = spread[..., dof, 1]
        return out

    def errors(
        self, predicted: Float[np.ndarray, "rows columns"], values: Float[np.ndarray, "rows columns"]
    ) -> Float[np.ndarray, "rows nv 2"]:
        """Recorded less predicted coordinates, turns in the predicted body's frame; 0 where nothing was recorded."""
        out = self.apart(predicted, self.unit(values))
        return np.where(np.isfinite(out), out, 0.0)

    def unit(self, values: Float[np.ndarray, "... columns"]) -> Float[np.ndarray, "... columns"]:
        """The same with quaternions of length 1."""
        out = np.array(values)
        for _, group in self.turns:
            size = np.linalg.norm(out[..., group], axis=-1, keepdims=True)
            out[..., group] /= np.where(size > 0, size, 1.0)
        return out

    def apart(
        self, predicted: Float[np.ndarray, "rows columns"], values: Float[np.ndarray, "rows columns"]
    ) -> Float[np.ndarray, "rows nv 2"]:
        """`errors` of values of `unit`; NaN where nothing was recorded."""
        out = np.zeros((len(predicted), self.model.nv, 2))
        dofs, parts, places = self._apart
        out[:, dofs, parts] = values[:, places] - predicted[:, places]
        for dof, group in self.turns:
            out[:, dof : dof + 3, 0] = relative_rotation(predicted[:, group], values[:, group])
        return out


def corrected(
    model: "mujoco.MjModel",
    qpos: Float[np.ndarray, "rows nq"],
    gains: Float[np.ndarray, "rows nv 2 2"],
    errors: Float[np.ndarray, "rows nv 2"],
) -> tuple[Float[np.ndarray, "rows nq"], Float[np.ndarray, "rows nv"]]:
    """Positions and the change of speeds after a sample."""
    change = np.einsum("rvij,rvj->rvi", gains, errors)
    return integrate_positions(model, qpos, change[:, :, 0]), change[:, :, 1]


def forgetting_gains(
    time: Float[np.ndarray, "segments samples"],
    seen: Bool[np.ndarray, "segments samples nv 2"],
    noise: Float[np.ndarray, "nv 2"],
    first_sd: Float[np.ndarray, "nv 2"],
    memory: float,
    contact: ContactFlow | None = None,
) -> tuple[Gains, Float[np.ndarray, "segments samples nv 2"]]:
    """Gains of a Kalman filter for a free mass a coordinate, and the sd of its innovations in sds of the noise.

    The first sample's error is the prior. Its covariance is divided by 1 - 1/memory at every sample (exponential
    forgetting; Ljung 1999, sec. 11.2), so that what a model lacks does not add up for longer. Where nothing is
    recorded nothing is corrected, nor forgotten. `contact` says what it does to variances between samples.
    """
    segments, samples, nv, _ = seen.shape
    gains, spread = np.zeros((segments, samples, nv, 2, 2)), np.ones((segments, samples, nv, 2))
    variance = np.where(np.isfinite(noise), noise, 1.0) ** 2
    p = np.tile(first_sd[:, :, None] ** 2 * np.eye(2), (segments, 1, 1, 1))
    for j in range(1, samples):
        dt = time[:, j] - time[:, j - 1]
        there = seen[:, j] & (dt > 0)[:, None, None]
        forget = np.where(there.any(-1), 1 - 1 / memory, 1.0)
        p = _carried(p, dt) / forget[..., None, None]
        if contact is not None:
            share = np.sqrt(contact.kept[:, j])
            p = share[..., :, None] * p * share[..., None, :] + contact.grown[:, j, :, None, None] * _since(dt)
        spread[:, j] = np.sqrt(1 + np.diagonal(p, axis1=-2, axis2=-1) / variance)
        for which in (0, 1):  # one after the other, as their noise is independent
            gain = p[..., which] * (there[..., which] / (p[..., which, which] + variance[:, which]))[..., None]
            first = gains[:, j, :, which].copy()
            gains[:, j] -= gain[..., None] * first[..., None, :]
            gains[:, j, ..., which] += gain
            p = p - gain[..., None] * p[..., None, which, :]
    return gains, spread


def _carried(p: Float[np.ndarray, "segments nv 2 2"], dt: Float[np.ndarray, " segments"]) -> np.ndarray:
    """Covariances of position and speed after a free motion."""
    f = np.tile(np.eye(2), (len(dt), 1, 1, 1))
    f[:, 0, 0, 1] = dt
    return f @ p @ np.swapaxes(f, -1, -2)


def _since(dt: Float[np.ndarray, " segments"]) -> Float[np.ndarray, "segments 1 2 2"]:
    """Covariance of position and speed after a jolt of unit variance at some time of an interval."""
    out = np.ones((len(dt), 1, 2, 2))
    out[:, 0, 0, 1] = out[:, 0, 1, 0] = dt / 2
    out[:, 0, 0, 0] = dt**2 / 3
    return out


def _turned_share(q: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 4 3"]:
    """Squared share that a turn about each of a body's axes has in each component; where none is recorded the mean."""
    w, x, y, z = (q[..., k] / np.linalg.norm(q, axis=-1) for k in range(4))
    rows = ((x, y, z), (w, z, y), (z, w, x), (y, x, w))  # of q * (0, angle) / 2, but for signs
    share = np.stack([np.stack(row, -1) for row in rows], -2) ** 2
    return np.where(np.isfinite(share), share, 0.25)
