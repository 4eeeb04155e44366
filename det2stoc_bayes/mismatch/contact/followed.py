"""A hypothesis on recordings that its simulations follow: what it foretells of each sample from those before.

Where bodies touch, a long prediction is chaotic, and no start is known well enough. So simulations are led along their
recordings by an observer, and judged by its innovations: under the right model they are the measurement's noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.engines.base import EffectRows, Request, Start, Trajectory
from det2stoc_bayes.engines.observer import Observer
from det2stoc_bayes.mismatch.contact.flow import Ground
from det2stoc_bayes.mismatch.contact.observers import make_observer, on_rows
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.problem import Problem, repeat_start
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import cut

BLOCK = 10  # samples that are counted together: their errors are not independent
MEMORY = 6.0  # samples over which an error is remembered
SPREAD, SEED = 0.5, 8  # noise sds by which members are parted, and its draws
FARTHEST = 1e6  # noise sds at which the error of a diverged prediction is counted


@dataclass(frozen=True, eq=False)
class Followed:
    """A hypothesis on whole recordings, each of them followed with so long a memory (samples)."""

    problem: Problem
    memory: float = MEMORY
    heard: Bool[np.ndarray, " columns"] | None = None  # columns that have a say; all where it is None
    ground: Ground | None = None  # whose simulations say what contact does to uncertainty
    members: int = 1  # simulations whose mean foretells

    @cached_property
    def _made(self) -> tuple[Observer, Float[np.ndarray, "recordings samples columns"]]:
        if self.ground is None:
            return make_observer(self.problem, self.memory)
        return self.ground.observer(self.problem.segments, self.memory)

    @property
    def observer(self) -> Observer:
        """It depends on the samples, their noise and the ground: all hypotheses have the same."""
        return self._made[0]

    @cached_property
    def _sd(self) -> Float[np.ndarray, "recordings samples columns"]:
        return self._made[1] * self.problem.noise

    @property
    def start(self) -> Start:
        """What was recorded first, rates of positions where speeds were not."""
        return self.problem.guess.start

    @cached_property
    def log_spread(self) -> Float[np.ndarray, "blocks samples columns"]:
        """Log sds of innovations in sds of the noise; NaN where nothing was recorded or is heard."""
        return self._cut(np.log(self._sd / self.problem.noise)[None])[0]

    @cached_property
    def volumes(self) -> Float[np.ndarray, " blocks"]:
        """Its sum over each block: by that densities of different memories are comparable."""
        return np.nansum(self.log_spread, axis=(1, 2))

    @property
    def blocks(self) -> int:
        """Blocks of each recording."""
        return -(-(self.problem.segments.time.shape[1] - 1) // BLOCK)

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.problem.segments.count * self.blocks

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of the errors of all samples: blocks, samples, columns."""
        return self.count, BLOCK, self.problem.segments.values.shape[-1]

    @cached_property
    def recording(self) -> Int[np.ndarray, " blocks"]:
        """Which recording each block belongs to."""
        return np.repeat(self.problem.segments.recording, self.blocks)

    def errors(self, z: Float[np.ndarray, "variants size"]) -> Float[np.ndarray, "variants blocks samples columns"]:
        """Innovations in sds of what noise makes of them; NaN where nothing was recorded."""
        return self._of(self._crowded(z))

    def errors_with(
        self, z: Float[np.ndarray, " size"], placed: PlacedEffect, values: Sequence[Mapping[str, Any]]
    ) -> Float[np.ndarray, "variants blocks samples columns"]:
        """The same with an effect added, for each of these parameter values."""
        count = self.problem.segments.count * self.members
        whole = self._crowded(np.tile(z, (len(values), 1)))
        wide = {n: np.repeat(np.array([np.asarray(v[n], float) for v in values]), count, axis=0) for n in values[0]}
        added = EffectRows(placed, slice(0, len(whole.which)), wide)
        return self._of(replace(whole, effects=(*whole.effects, added)))

    def path(self, z: Float[np.ndarray, " size"]) -> Trajectory:
        """Predictions of every sample, and the states after its correction."""
        engine = self.problem.simulator.engine
        return engine.trajectory(self._request(z[None]))

    def drawn(
        self, z: Float[np.ndarray, " size"], random: np.random.Generator
    ) -> Float[np.ndarray, "recordings samples columns"]:
        """Samples as the hypothesis itself makes them: innovations are drawn, and followed by one simulation.

        The mean of some foretells them with errors beyond the drawn ones, as it does what was recorded of a real body.
        """
        noise = self._sd * random.standard_normal(self._sd.shape)
        observer = replace(self.observer, values=noise, drawn=True)
        predicted = self.problem.simulator.rollout(replace(self._request(z[None]), observer=observer))
        return predicted + noise

    def _request(self, z: np.ndarray) -> Request:
        return replace(self.problem.request(z, repeat_start(self.start, len(z))), observer=self.observer)

    def _crowded(self, z: np.ndarray) -> Request:
        """The same of all members, those of a recording one after the other."""
        if self.members == 1:
            return self._request(z)
        many = on_rows(self.problem, self._rows)
        return replace(many.request(z, repeat_start(self.start[self._rows], len(z))), observer=self._crowd)

    def _of(self, request: Request) -> np.ndarray:
        # Of each member the residuals, for q and -q are one turn; where one diverges nothing is foretold.
        predicted, segments = self.problem.simulator.rollout(request), self.problem.segments
        shape = predicted.shape[1:]
        each = predicted.reshape(-1, segments.count, self.members, *shape)
        left = [self.problem.residuals(each[:, :, k].reshape(-1, *shape)) for k in range(self.members)]
        return self.in_blocks(np.mean(left, axis=0).reshape(-1, *shape))

    @property
    def _rows(self) -> Int[np.ndarray, " rows"]:
        """The recording of each member."""
        return np.repeat(np.arange(self.problem.segments.count), self.members)

    @cached_property
    def _crowd(self) -> Observer:
        """Of all members: noise that is drawn anew, once with either sign, parts them where contact is chaotic."""
        random, led, rows = np.random.default_rng(SEED), self.observer, self._rows
        noise = SPREAD * self.problem.noise * random.standard_normal((self.members // 2, *led.values.shape))
        both = np.swapaxes(np.stack([noise, -noise], 1).reshape(self.members, *led.values.shape), 0, 1)
        values = led.values[rows] + both.reshape(-1, *led.values.shape[1:])
        return replace(_led_by(led, rows), values=values)

    def in_blocks(
        self, errors: Float[np.ndarray, "rows times columns"]
    ) -> Float[np.ndarray, "variants blocks samples columns"]:
        """Recorded minus predicted values, the first sample's apart, as `errors` has them."""
        e = errors.reshape(-1, *self.problem.segments.values.shape) / self._sd
        with np.errstate(invalid="ignore"):
            e = np.where(np.abs(e) < FARTHEST, e, FARTHEST)
        return self._cut(e)

    def in_blocks_of_noise(
        self, errors: Float[np.ndarray, "recordings times columns"]
    ) -> Float[np.ndarray, "blocks samples columns"]:
        """Errors in noise sds of whatever foretells the samples."""
        return self._cut(errors[None])[0]

    def _cut(self, rows: Float[np.ndarray, "variants recordings times columns"]) -> np.ndarray:
        """Blocks of what was recorded and is heard, the first sample apart."""
        there = self.problem.segments.observed & self._real[..., None]
        there = there if self.heard is None else there & self.heard
        room = self.blocks * BLOCK - rows.shape[2] + 1
        padded = np.pad(
            np.where(there, rows, np.nan)[:, :, 1:], ((0, 0), (0, 0), (0, room), (0, 0)), constant_values=np.nan
        )
        return padded.reshape(len(rows), self.count, BLOCK, rows.shape[3])

    @cached_property
    def _real(self) -> Bool[np.ndarray, "recordings samples"]:
        return np.diff(self.problem.segments.time, axis=1, prepend=-np.inf) > 0  # and no padding

    def leads_as(self, other: "Followed") -> bool:
        """Whether simulations are led and heard alike, so that sensitivities are: these are by the believed steps."""
        mine, its = self.problem.segments, other.problem.segments
        return mine.key == its.key and self._led == other._led and _same(mine.values, its.values)

    @property
    def _led(self) -> tuple[float, int, int, int]:
        return self.memory, id(self.heard), id(self.ground), self.members

    def led_as(self, other: "Followed") -> "Followed":
        """The same hypothesis and recordings, led and heard as others are."""
        if self._led == other._led:
            return self
        return replace(self, memory=other.memory, heard=other.heard, ground=other.ground, members=other.members)

    def with_problem(self, problem: Problem) -> "Followed":
        """The same recordings under another hypothesis."""
        other = replace(self, problem=problem)
        if problem.segments is self.problem.segments:
            other.__dict__.update(
                (k, v)
                for k, v in self.__dict__.items()
                if k in ("_made", "_crowd", "_sd", "volumes", "log_spread", "_real")
            )
        return other

    def remembering(self, memory: float) -> "Followed":
        """The same with another memory."""
        return self if memory == self.memory else replace(self, memory=memory)

    def integrated(self, timestep: float | None, integrator: str | None) -> "Followed":
        """The same under another integration."""
        return self.with_problem(replace(self.problem, timestep=timestep, integrator=integrator))

    def hearing(self, heard: Bool[np.ndarray, " columns"]) -> "Followed":
        """The same by some columns alone; all of them lead the simulations."""
        return replace(self, heard=heard)

    def only(self, rows: Int[np.ndarray, " rows"]) -> "Followed":
        """Some of the recordings; unknowns of the others stay."""
        some = replace(self, problem=on_rows(self.problem, rows))
        some.__dict__["_made"] = _led_by(self.observer, rows), self._made[1][rows]
        if self.members > 1:
            places = rows[:, None] * self.members + np.arange(self.members)
            some.__dict__["_crowd"] = _led_by(self._crowd, places.ravel())
        return some

    def averaged(self, members: int) -> "Followed":
        """The same, foretold by the mean of so many simulations: 1, or an even number."""
        assert members == 1 or members % 2 == 0, members
        return self if members == self.members else replace(self, members=members)

    def grounded(self, ground: Ground) -> "Followed":
        """The same, led with regard to what contact does to a hypothesis' simulations."""
        return replace(self, ground=ground)

    def on(self, recordings: Sequence[Recording]) -> "Followed":
        """The same hypothesis on other recordings."""
        return replace(self, problem=self.problem.on(cut(recordings, None, self.problem.segments.columns)))


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return a is b or np.array_equal(a, b, equal_nan=True)


def _led_by(observer: Observer, rows: Int[np.ndarray, " rows"]) -> Observer:
    """Some of the recordings' rows."""
    return replace(observer, **{n: getattr(observer, n)[rows] for n in ("gains", "values", "seen")})
