"""A study as an inference problem: unknowns as independent standard normals, and predictions of the recordings.

Every unknown is a standard normal z; psi and effect parameters follow by their priors' inverse distribution
functions, so that the prior is N(0, I) whatever the study's priors are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.engines.base import Counter, EffectRows, Request, Start
from det2stoc_bayes.engines.layout import integrate_positions, quaternion_groups
from det2stoc_bayes.likelihood import residuals
from det2stoc_bayes.measurement import Measurement
from det2stoc_bayes.mismatch.effects.base import PlacedEffect
from det2stoc_bayes.noise import noise_sd
from det2stoc_bayes.segments import Segments, cut
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.starts import StartGuess, guess_starts
from det2stoc_bayes.unknowns import Unknowns, carried, first_spreads, lay_out

Array = Any  # numpy or jax array
FARTHEST = 6.0  # prior sds of psi from its median: beyond it a bounded prior's quantiles lose their digits


@dataclass(frozen=True, eq=False)
class Finer:
    """An integration that converges, and what it adds to predictions by the believed one, found at one point."""

    timestep: float
    integrator: str
    shift: Float[np.ndarray, "segments samples columns"]


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
    finer: Finer | None = None
    spreads: tuple[float, ...] | None = ()  # sigma of each psi that varies by recording; None: unknowns, too

    @cached_property
    def unknowns(self) -> Unknowns:
        """Which of z belong to which psi."""
        names = [r.name for r in self.segments.recordings]
        return lay_out(self.simulator.parameters, names, self.spreads)

    @property
    def engine(self) -> str:
        """What simulates: c or mjx."""
        return self.simulator.engine.name

    @property
    def counter(self) -> Counter:
        """Simulations run so far."""
        return self.simulator.counter

    @property
    def recordings(self) -> tuple[str, ...]:
        """Names of the recordings."""
        return tuple(r.name for r in self.segments.recordings)

    @property
    def num_psi(self) -> int:
        """Number of unknowns of the simulator's parameters."""
        return self.unknowns.size

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.num_psi + sum(e.size for e in self.effects)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """psi's unknowns, then `<effect>[<element>].<parameter>`, of a vector with `.x`, `.y`, `.z`."""
        added = [name for e in self.effects for name in e.unknowns]
        return (*self.unknowns.names, *added)

    @cached_property
    def quaternions(self) -> list[list[int]]:
        """Column groups that are one rotation."""
        return quaternion_groups(self.segments.columns, self.simulator.study.names.quaternions)

    @property
    def measurement(self) -> Measurement:
        """How recorded values scatter."""
        return self.simulator.study.measurement

    @cached_property
    def weight(self) -> Float[np.ndarray, "segments values"]:
        """1 / noise sd for every recorded value, 0 elsewhere."""
        return np.where(self.segments.observed, 1.0 / self.noise, 0.0).reshape(self.segments.count, -1)

    def with_effects(self, effects: Sequence[PlacedEffect]) -> "Problem":
        """The same samples under another hypothesis."""
        return replace(self, effects=tuple(effects))

    def only(self, rows: Int[np.ndarray, " rows"]) -> "Problem":
        """Some of its segments, everything else as it is."""
        segments, finer = self.segments.only(rows), self.finer
        if finer is not None:
            finer = replace(finer, shift=finer.shift[rows, : segments.time.shape[1]])
        return replace(self, segments=segments, guess=self.guess[rows], finer=finer)

    def on(self, segments: Segments) -> "Problem":
        """The same hypothesis on other samples, where a finer integration is used in full."""
        options = {"timestep": self.timestep, "integrator": self.integrator}
        if self.finer is not None:
            options = {"timestep": self.finer.timestep, "integrator": self.finer.integrator}
        guess = guess_starts(self.simulator.model, segments)
        return replace(self, segments=segments, guess=guess, finer=None, **options)

    def carry(self, z: Float[np.ndarray, " size"], to: "Problem") -> Float[np.ndarray, " new_size"]:
        """These unknowns in the layout of the same hypothesis on other recordings or with other spreads."""
        return carried(z, self.unknowns, to.unknowns)

    def psi(self, z: Array, xp: Any = np) -> Array:
        """Simulator parameters (..., psi) from unknowns (..., size) of either library; a population's mean."""
        return self.unknowns.population(z, xp)

    def psi_by_segment(self, z: Array, xp: Any = np) -> Array:
        """Simulator parameters of every segment (..., segments, psi), in their own units."""
        return self.unknowns.by_recording(z, xp)[..., self.segments.recording, :]

    def straightened(self, z: Float[np.ndarray, " size"], at: Float[np.ndarray, " size"]) -> Float[np.ndarray, " size"]:
        """z - at in coordinates in which psi is linear, of unit slope at `at`: what a prediction linear in psi sees."""
        return self.straightener(at)(z)

    def slopes(self, z: Float[np.ndarray, " size"]) -> Float[np.ndarray, " size"]:
        """d psi / dz at z, 0 where psi stands still in double precision; 1 for the other unknowns."""
        out = np.ones(self.size)
        for b in self.unknowns.blocks:
            out[b.begin] = b.tangent(float(z[b.begin]))[1]
        return out

    def straightener(
        self, at: Float[np.ndarray, " size"]
    ) -> Callable[[Float[np.ndarray, " size"]], Float[np.ndarray, " size"]]:
        """`straightened` at one place, for many z."""
        tangents = [(b, *b.tangent(float(at[b.begin]))) for b in self.unknowns.blocks]

        def straight(z):
            out = z - at
            for b, here, slope in tangents:
                if slope > 0:  # at a bound's very edge psi stands still in double precision
                    out[b.begin] = (float(b.population(z)) - here) / slope
            return out

        return straight

    def bent(self, at: Float[np.ndarray, " size"], straight: Float[np.ndarray, " size"]) -> Float[np.ndarray, " size"]:
        """The inverse of `straightened`: where a change leads that was found linear in psi; within the prior."""
        out = at + straight
        for b in self.unknowns.blocks:
            j, prior = b.begin, b.parameter.prior
            here, slope = b.tangent(float(at[j]))
            psi = np.clip(here + straight[j] * slope, *prior.from_normal(np.array([-FARTHEST, FARTHEST])))
            out[j] = np.clip(float(prior.to_normal(psi)), -FARTHEST, FARTHEST)
        return out

    def nudge(self, z: Float[np.ndarray, " size"], moved: Int[np.ndarray, " moved"], step: float) -> float:
        """A step of these unknowns for a finite difference: longer, and inwards, where psi hardly changes with z."""
        for b in self.unknowns.blocks:
            if len(moved) == 1 and moved[0] == b.begin and abs(z[b.begin]) > 2:
                prior, at = b.parameter.prior, float(z[b.begin])
                middle = abs(float(np.diff(prior.from_normal(np.array([0.0, step])))[0]))
                step *= -np.sign(at)
                while abs(float(np.diff(prior.from_normal(np.array([at, at + step])))[0])) < middle and abs(step) < 1:
                    step *= 2
        return float(step)

    def between(
        self, a: Float[np.ndarray, " size"], b: Float[np.ndarray, " size"], fraction: float
    ) -> Float[np.ndarray, " size"]:
        """The point on the way from a to b that is straight in psi."""
        out = a + fraction * (b - a)
        for block in self.unknowns.blocks:
            j, prior = block.begin, block.parameter.prior
            first, last = prior.from_normal(np.array([a[j], b[j]]))
            z = float(prior.to_normal(first + fraction * (last - first)))
            out[j] = z if np.isfinite(z) else out[j]
        return out

    def probes(self, unknowns: Literal["all", "own"] = "all") -> list[Int[np.ndarray, " moved"]]:
        """Unknowns to move together in a finite difference: values of different recordings never meet in a prediction.

        "own": only those that belong to single recordings.
        """
        together = self.unknowns.own
        if unknowns == "own":
            return list(together)
        single = np.setdiff1d(np.arange(self.size), self.unknowns.owned)
        return [*(np.array([i]) for i in single), *together]

    @cached_property
    def floor(self) -> Float[np.ndarray, " size"]:
        """The least that each unknown may be: parameters of effects that must be positive."""
        parts = [e.effect.floor(e.typical) for e in self.effects]
        return np.concatenate([np.full(self.num_psi, -np.inf), *parts])

    def effect_values(self, z: Array, xp: Any = np) -> list[dict[str, Array]]:
        """Parameters (...) or (..., 3) of each effect, in their own units, from unknowns (..., size)."""
        out, begin = [], self.num_psi
        for effect in self.effects:
            out.append(effect.from_normal([z[..., begin + i] for i in range(effect.size)], xp))
            begin += effect.size
        return out

    def constrained(self, z: Array, xp: Any = np) -> dict[str, Array]:
        """Every unknown by name in its own unit, for arrays (..., size) of either library."""
        out = self.unknowns.constrained(z, xp)
        for placed, parameters in zip(self.effects, self.effect_values(z, xp), strict=True):
            out |= dict(zip(placed.unknowns, placed.scalars(parameters), strict=True))
        return out

    def request(self, z: Float[np.ndarray, "variants size"], start: Start) -> Request:
        """Simulations of every segment for every variant of the unknowns; rows are variant-major."""
        psi = self.psi_by_segment(z).reshape(len(z) * self.segments.count, len(self.simulator.parameters))
        z = np.repeat(z, self.segments.count, axis=0)
        everywhere = slice(0, len(z))
        effects = tuple(
            EffectRows(placed, everywhere, values)
            for placed, values in zip(self.effects, self.effect_values(z), strict=True)
        )
        return self.request_under(psi, start, effects)

    def request_under(
        self, psi: Float[np.ndarray, "rows psi"], start: Start, effects: tuple[EffectRows, ...] = ()
    ) -> Request:
        """Simulations of every segment under psi given row by row, variant-major."""
        which = np.tile(np.arange(self.segments.count), len(psi) // self.segments.count)
        names = [self.segments.recordings[self.segments.recording[w]].name for w in which]
        fields = self.simulator.fields(psi, names)
        return Request(self.segments, which, start, fields, effects, self.timestep, self.integrator)

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
        variants = len(predicted) // self.segments.count
        observed = np.tile(self.segments.values, (variants, 1, 1))
        if self.finer is not None:
            predicted = predicted + np.tile(self.finer.shift, (variants, 1, 1))
        return residuals(predicted, observed, self.quaternions)


def make_problem(simulator: Simulator, *, num_samples: int | None = None, noise=None) -> Problem:
    """A study's recordings cut into segments of `num_samples` samples (None: whole recordings)."""
    segments = cut(simulator.study.recordings, num_samples)
    sd = noise_sd(segments, simulator.study.noise) if noise is None else noise
    spreads = first_spreads(simulator.parameters)
    return Problem(simulator, segments, sd, guess_starts(simulator.model, segments), spreads=spreads)


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
