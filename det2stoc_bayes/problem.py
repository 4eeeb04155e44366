"""A study as an inference problem: unknowns as independent standard normals, and predictions of the recordings.

Every unknown is a standard normal z; psi and effect parameters follow by their priors' inverse distribution
functions, so that the prior is N(0, I) whatever the study's priors are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.engines.layout import integrate_positions, quaternion_groups
from det2stoc_bayes.errors import MethodNotApplicable
from det2stoc_bayes.likelihood import residuals
from det2stoc_bayes.mismatch.effects.base import PlacedEffect
from det2stoc_bayes.noise import noise_sd
from det2stoc_bayes.segments import Segments, cut
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.starts import StartGuess, guess_starts

Array = Any  # numpy or jax array


@dataclass(frozen=True, eq=False)
class Problem:
    """Simulator, samples, noise and the effects that are added to the believed model."""

    simulator: Simulator
    segments: Segments
    noise: Float[np.ndarray, " columns"]
    guess: StartGuess
    effects: tuple[PlacedEffect, ...] = ()
    timestep: float | None = None
    integrator: str | None = None

    @property
    def num_psi(self) -> int:
        """Number of simulator parameters."""
        return len(self.simulator.parameters)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.num_psi + sum(e.size for e in self.effects)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """psi by name, then `<effect>[<element>].<parameter>`, of a vector with `.x`, `.y`, `.z`."""
        added = [name for e in self.effects for name in e.unknowns]
        return (*(p.name for p in self.simulator.parameters), *added)

    @cached_property
    def quaternions(self) -> list[list[int]]:
        """Column groups that are one rotation."""
        return quaternion_groups(self.segments.columns)

    @cached_property
    def weight(self) -> Float[np.ndarray, "segments values"]:
        """1 / noise sd for every recorded value, 0 elsewhere."""
        return np.where(self.segments.observed, 1.0 / self.noise, 0.0).reshape(self.segments.count, -1)

    def with_effects(self, effects: Sequence[PlacedEffect]) -> "Problem":
        """The same samples under another hypothesis."""
        return replace(self, effects=tuple(effects))

    def on(self, segments: Segments) -> "Problem":
        """The same hypothesis on other samples."""
        return replace(self, segments=segments, guess=guess_starts(self.simulator.model, segments))

    def psi(self, z: Array, xp: Any = np) -> Array:
        """Simulator parameters (..., psi) in their own units from unknowns (..., size) of either library."""
        columns = [p.prior.from_normal(z[..., j], xp) for j, p in enumerate(self.simulator.parameters)]
        return xp.stack(columns, -1) if columns else xp.zeros((*z.shape[:-1], 0))

    def effect_values(self, z: Array, xp: Any = np) -> list[dict[str, Array]]:
        """Parameters (...) or (..., 3) of each effect, in their own units, from unknowns (..., size)."""
        out, begin = [], self.num_psi
        for effect in self.effects:
            out.append(effect.from_normal([z[..., begin + i] for i in range(effect.size)], xp))
            begin += effect.size
        return out

    def constrained(self, z: Float[np.ndarray, "points size"]) -> dict[str, Float[np.ndarray, " points"]]:
        """Every unknown by name in its own unit."""
        values = list(np.moveaxis(self.psi(z), -1, 0))
        for placed, parameters in zip(self.effects, self.effect_values(z), strict=True):
            values += placed.scalars(parameters)
        return dict(zip(self.names, values, strict=True))

    def request(self, z: Float[np.ndarray, "variants size"], start: Start) -> Request:
        """Simulations of every segment for every variant of the unknowns; rows are variant-major."""
        which = np.tile(np.arange(self.segments.count), len(z))
        names = [self.segments.recordings[self.segments.recording[w]].name for w in which]
        z = np.repeat(z, self.segments.count, axis=0)
        everywhere = slice(0, len(which))
        effects = tuple(
            EffectRows(placed, everywhere, values)
            for placed, values in zip(self.effects, self.effect_values(z), strict=True)
        )
        return Request(
            self.segments,
            which,
            start,
            self.simulator.fields(self.psi(z), names),
            effects,
            self.timestep,
            self.integrator,
        )

    def moved(self, start: Start, change: Float[np.ndarray, "rows states"]) -> Start:
        """Starts moved along tangent vectors (positions, velocities)."""
        model = self.simulator.model
        return Start(
            integrate_positions(model, start.qpos, change[:, : model.nv]),
            start.qvel + change[:, model.nv :],
            start.act,
        )

    def residuals(self, predicted: Float[np.ndarray, "rows samples columns"]) -> Float[np.ndarray, "rows values"]:
        """Recorded minus predicted, for variant-major rows."""
        observed = np.tile(self.segments.values, (len(predicted) // self.segments.count, 1, 1))
        return residuals(predicted, observed, self.quaternions)


def make_problem(simulator: Simulator, *, num_samples: int | None = None, noise=None) -> Problem:
    """A study's recordings cut into segments of `num_samples` samples (None: whole recordings).

    Raises MethodNotApplicable for a psi that varies from recording to recording.
    """
    for p in simulator.parameters:
        if p.varies != "never":
            raise MethodNotApplicable(
                f'{simulator.study.name}: psi.{p.name}.varies is "{p.varies}", for which there is no likelihood; '
                'allowed: "never"'
            )
    segments = cut(simulator.study.recordings, num_samples)
    sd = noise_sd(segments, simulator.study.noise) if noise is None else noise
    return Problem(simulator, segments, sd, guess_starts(simulator.model, segments))


def repeat_start(start: Start, times: int) -> Start:
    """The same starts, several times over."""
    return Start(*(np.tile(a, (times, 1)) for a in (start.qpos, start.qvel, start.act)))


def merge_requests(requests: Sequence[Request]) -> Request:
    """One request out of several on the same segments and options, rows in order."""
    effects, begin = [], 0
    for r in requests:
        effects += [
            EffectRows(e.placed, slice(e.rows.start + begin, e.rows.stop + begin), e.parameters) for e in r.effects
        ]
        begin += len(r.which)
    first = requests[0]
    start = Start(*(np.concatenate([getattr(r.start, a) for r in requests]) for a in ("qpos", "qvel", "act")))
    fields = {k: np.concatenate([r.fields[k] for r in requests]) for k in first.fields}
    which = np.concatenate([r.which for r in requests])
    return Request(first.segments, which, start, fields, tuple(effects), first.timestep, first.integrator)
