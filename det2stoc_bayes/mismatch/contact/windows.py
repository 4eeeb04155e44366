"""Short windows of recordings, each predicted from its first samples, and the errors at a few horizons.

Where bodies touch, a long prediction is chaotic and a start that is fitted has no derivative worth the name. So each
window starts where its first samples say, and the error of that start is left in what is predicted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.problem import Finer, Problem, repeat_start
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import Segments, from_pieces

LENGTH, STRIDE = 20, 10  # samples that a window predicts, and from one window to the next
HORIZONS = (1, 2, 5, 10, 20)  # samples after the start
MOST = 240  # windows; of longer studies every few are taken
FARTHEST = 1e6  # noise sds at which the error of a diverged prediction is counted
ROWS = 40_000  # simulated window samples at once


@dataclass(frozen=True, eq=False)
class Windows:
    """A hypothesis on windows; `horizons` are the samples that are looked at, in the columns that are `heard`."""

    problem: Problem
    horizons: tuple[int, ...]
    heard: Bool[np.ndarray, "horizons columns"] | None = None  # all where it is None

    @property
    def count(self) -> int:
        """Number of windows."""
        return self.problem.segments.count

    @property
    def recording(self) -> Int[np.ndarray, " windows"]:
        """Which recording each belongs to."""
        return self.problem.segments.recording

    def errors(
        self, z: Float[np.ndarray, "variants size"], start: Start | None = None
    ) -> Float[np.ndarray, "variants windows horizons columns"]:
        """Recorded minus predicted values in noise sds; NaN where nothing was recorded or is heard.

        start: one a variant and window, variant-major; by default the windows' own for every variant.
        """
        size, count = max(1, ROWS // self.problem.segments.time.size), self.count
        own, parts = self.problem.guess.start, []
        for i in range(0, len(z), size):
            some = z[i : i + size]
            here = repeat_start(own, len(some)) if start is None else start[i * count : (i + len(some)) * count]
            parts.append(self._of(self.problem.request(some, here)))
        return np.concatenate(parts)

    def errors_with(
        self, z: Float[np.ndarray, " size"], placed: PlacedEffect, values: Sequence[Mapping[str, Any]]
    ) -> Float[np.ndarray, "variants windows horizons columns"]:
        """The same with an effect added, for each of these parameter values."""
        start, count = self.problem.guess.start, self.count
        whole = self.problem.request(np.tile(z, (len(values), 1)), repeat_start(start, len(values)))
        wide = {n: np.repeat(np.array([np.asarray(v[n], float) for v in values]), count, axis=0) for n in values[0]}
        added = EffectRows(placed, slice(0, len(whole.which)), wide)
        return self._of(replace(whole, effects=(*whole.effects, added)))

    def _of(self, request: Request) -> np.ndarray:
        problem, segments = self.problem, self.problem.segments
        predicted = problem.simulator.rollout(request)
        shape = (len(predicted) // segments.count, segments.count, segments.time.shape[1], len(segments.columns))
        e = problem.residuals(predicted).reshape(shape)[:, :, list(self.horizons)] / problem.noise
        with np.errstate(invalid="ignore"):
            e = np.where(np.abs(e) < FARTHEST, e, FARTHEST)
        return np.where(self.observed, e, np.nan)

    @property
    def observed(self) -> Bool[np.ndarray, "windows horizons columns"]:
        """Where a value was recorded and is heard."""
        there = self.problem.segments.observed[:, list(self.horizons)]
        return there if self.heard is None else there & self.heard

    def with_problem(self, problem: Problem) -> "Windows":
        """The same windows under another hypothesis."""
        return replace(self, problem=problem)

    def only(self, rows: Int[np.ndarray, " rows"]) -> "Windows":
        """Some of the windows; all recordings stay."""
        problem = self.problem
        whole, guess, finer = problem.segments, problem.guess, problem.finer
        each = {n: getattr(whole, n)[rows] for n in ("recording", "first", "time", "values")}
        guess = replace(guess, start=guess.start[rows], prior_sd=guess.prior_sd[rows])
        finer = None if finer is None else replace(finer, shift=finer.shift[rows])
        return self.with_problem(replace(problem, segments=replace(whole, **each), guess=guess, finer=finer))

    def starting(self, start: Start) -> "Windows":
        """The same from other initial states."""
        return self.with_problem(replace(self.problem, guess=replace(self.problem.guess, start=start)))

    def taking(self, other: "Windows", rows: Bool[np.ndarray, " windows"]) -> "Windows":
        """The same with another hypothesis's starts of some windows, and its integration's error from there."""
        moved = self.starting(self.problem.guess.start.taking(other.problem.guess.start, rows))
        finer, their = self.problem.finer, other.problem.finer
        if finer is None or their is None:
            return moved
        finer = replace(finer, shift=np.where(rows[:, None, None], their.shift, finer.shift))
        return moved.with_problem(replace(moved.problem, finer=finer))

    def predicted(self, z: Float[np.ndarray, " size"]) -> Float[np.ndarray, "windows samples columns"]:
        """Predictions of every sample."""
        problem = self.problem
        out = problem.simulator.rollout(problem.request(z[None], problem.guess.start))
        return out if problem.finer is None else out + problem.finer.shift

    def shifted(self, z: Float[np.ndarray, " size"], timestep: float, integrator: str) -> "Windows":
        """The same with the believed integration's error taken off, as it is at these unknowns."""
        bare = replace(self.problem, timestep=None, integrator=None, finer=None)
        fine = replace(bare, timestep=timestep, integrator=integrator)
        shift = self.with_problem(fine).predicted(z) - self.with_problem(bare).predicted(z)
        shift = np.where(np.isfinite(shift), shift, 0.0)
        return self.with_problem(replace(bare, finer=Finer(timestep, integrator, shift)))

    def fine(self) -> "Windows":
        """The same with the finer integration in full."""
        finer = self.problem.finer
        if finer is None:
            return self
        options = {"timestep": finer.timestep, "integrator": finer.integrator, "finer": None}
        return self.with_problem(replace(self.problem, **options))

    def on(self, recordings: Sequence[Recording], most: int = MOST) -> "Windows":
        """The same hypothesis on other recordings."""
        return self.with_problem(self.problem.on(pieces(recordings, self.problem.segments.columns, most)))


def make_windows(problem: Problem) -> Windows:
    """A study's recordings in windows."""
    segments = pieces(problem.segments.recordings, problem.segments.columns)
    last = segments.time.shape[1] - 1
    return Windows(problem.on(segments), tuple(h for h in HORIZONS if h <= last) or (last,))


def pieces(recordings: Sequence[Recording], columns: tuple[str, ...], most: int = MOST) -> Segments:
    """Windows of LENGTH samples beyond their start, STRIDE apart; every few of them where there are too many."""
    found = []
    for r, record in enumerate(recordings):
        count = len(record.time)
        begins = range(0, max(count - LENGTH, 1), STRIDE)
        found += [(r, b, min(b + LENGTH + 1, count)) for b in begins]
    every = int(np.ceil(len(found) / most))
    return from_pieces(recordings, found[::every], columns)
