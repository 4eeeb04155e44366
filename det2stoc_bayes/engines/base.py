"""What every engine takes and gives."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.engines.observer import Observer
from det2stoc_bayes.mismatch.effects.base import PlacedEffect
from det2stoc_bayes.segments import Segments


@dataclass(frozen=True)
class EffectRows:
    """An effect that acts in some of the simulations, with parameters for each of them."""

    placed: PlacedEffect
    rows: slice
    parameters: Mapping[str, Float[np.ndarray, "rows *components"]]

    @classmethod
    def alike(cls, placed: PlacedEffect, count: int, values: Mapping[str, Any]) -> "EffectRows":
        """The same parameters in each of the first `count` simulations."""
        wide = {n: np.tile(np.asarray(v, float), (count, *(1,) * np.ndim(v))) for n, v in values.items()}
        return cls(placed, slice(0, count), wide)


@dataclass(frozen=True)
class Start:
    """Initial states, one a simulation."""

    qpos: Float[np.ndarray, "sims nq"]
    qvel: Float[np.ndarray, "sims nv"]
    act: Float[np.ndarray, "sims na"]

    def __getitem__(self, rows) -> "Start":
        return Start(self.qpos[rows], self.qvel[rows], self.act[rows])

    def taking(self, other: "Start", rows: Bool[np.ndarray, " sims"]) -> "Start":
        """The same with another's positions and velocities in some rows."""
        wide = rows[:, None]
        return Start(np.where(wide, other.qpos, self.qpos), np.where(wide, other.qvel, self.qvel), self.act)


@dataclass(frozen=True)
class Request:
    """Simulations to run: `which` segment each one follows, from which start, with which model fields and effects."""

    segments: Segments
    which: Int[np.ndarray, " sims"]
    start: Start
    fields: Mapping[str, np.ndarray]  # mjModel's name (`dof_damping`, `opt.gravity`) -> (sims, ...)
    effects: tuple[EffectRows, ...] = ()
    timestep: float | None = None  # None: the model's own
    integrator: str | None = None
    observer: Observer | None = None  # leads the simulations along their samples


@dataclass(frozen=True)
class Trajectory:
    """Predicted columns and the states behind them at the sample times."""

    columns: Float[np.ndarray, "sims samples columns"]
    qpos: Float[np.ndarray, "sims samples nq"]
    qvel: Float[np.ndarray, "sims samples nv"]
    act: Float[np.ndarray, "sims samples na"]


@dataclass
class Counter:
    """Simulations and steps run so far: what a result cost."""

    simulations: int = 0
    steps: int = 0
    gradients: int = field(default=0)


@runtime_checkable
class Engine(Protocol):
    """Runs requests."""

    name: str
    counter: Counter

    def rollout(self, request: Request) -> Float[np.ndarray, "sims samples columns"]:
        """Predicted values of the segments' columns at their sample times; NaN where a simulation diverged."""
        ...

    def trajectory(self, request: Request) -> Trajectory:
        """The same with the states behind them."""
        ...
