"""Stretches of recordings that are simulated from a start of their own."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from det2stoc_bayes.recording import Recording

TIME_SLACK = 1e-6  # of a step: times that differ by less are the same


class Commands(NamedTuple):
    """Held commands as a simulation takes them, in the arrays of any engine.

    each: (rows, steps, ctrl) mean over every step. around: None where all samples are on steps, else twice (rows,
    samples, ctrl), the mean from the last step before a sample to the sample, and what holds from the sample on.
    """

    each: Any
    around: tuple[Any, Any] | None

    def map(self, change: Callable[[Any], Any]) -> "Commands":
        """The same change of every array."""
        around = None if self.around is None else (change(self.around[0]), change(self.around[1]))
        return Commands(change(self.each), around)


@dataclass(frozen=True, eq=False)
class Segments:
    """Padded samples of several stretches. Rows of `time` are padded with their last value, of `values` with NaN."""

    recordings: tuple[Recording, ...]
    columns: tuple[str, ...]
    recording: Int[np.ndarray, " segments"]
    first: Int[np.ndarray, " segments"]
    time: Float[np.ndarray, "segments samples"]
    values: Float[np.ndarray, "segments samples columns"]

    @property
    def count(self) -> int:
        """Number of segments."""
        return len(self.recording)

    @cached_property
    def observed(self) -> Bool[np.ndarray, "segments samples columns"]:
        """Where a value was recorded."""
        return np.isfinite(self.values)

    @cached_property
    def lengths(self) -> Int[np.ndarray, " segments"]:
        """Samples of each segment, padding not counted."""
        return (np.diff(self.time, axis=1) > 0).sum(1) + 1

    @property
    def whole(self) -> bool:
        """Whether every recording is one segment, from its first sample to its last."""
        lengths = [len(r.time) for r in self.recordings]
        return self.count == len(lengths) and bool((self.lengths == np.array(lengths)[self.recording]).all())

    @property
    def extent(self) -> tuple[int, int]:
        """Samples of the longest segment, and the number of segments: two cuts of the same recordings differ in it."""
        return self.time.shape[1], self.count

    @property
    def key(self) -> tuple[tuple[int, int], bytes]:
        """The same for segments of the same samples."""
        return self.extent, self.recording.tobytes() + self.first.tobytes()

    def only(self, rows: Int[np.ndarray, " rows"]) -> "Segments":
        """Some of the segments; all recordings stay."""
        longest = int(self.lengths[rows].max())
        time, values = self.time[rows, :longest], self.values[rows, :longest]
        return replace(self, recording=self.recording[rows], first=self.first[rows], time=time, values=values)

    def evenly(self, num_samples: float) -> Int[np.ndarray, " rows"]:
        """Segments of about so many samples in all, spread over each recording; of each at least one."""
        every = max(int(np.ceil(self.lengths.sum() / num_samples)), 1)
        return np.concatenate([own[min(every // 2, len(own) - 1) :: every] for own in self._by_recording()])

    def beginnings(self, nth: int) -> Int[np.ndarray, " rows"]:
        """Of each recording the first segment and every nth after it: with these so much longer ones begin."""
        return np.concatenate([own[::nth] for own in self._by_recording()])

    def _by_recording(self) -> list[Int[np.ndarray, " rows"]]:
        """The rows of each recording."""
        return [np.flatnonzero(self.recording == r) for r in np.unique(self.recording)]

    def steps(self, timestep: float) -> Int[np.ndarray, " segments"]:
        """Simulation steps that reach each segment's last sample."""
        return np.maximum(np.ceil((self.time[:, -1] - self.time[:, 0]) / timestep - TIME_SLACK).astype(int), 1)

    def in_steps(self, timestep: float) -> Float[np.ndarray, "segments samples"]:
        """Steps from each segment's start to its samples, whole ones as whole numbers."""
        return snapped((self.time - self.time[:, :1]) / timestep)

    def commands(
        self, which: Int[np.ndarray, " rows"], timestep: float, num_steps: int, num_before: int = 0
    ) -> Commands:
        """The held command's mean over every step of some segments, `num_before` steps before their start included.

        A command that comes within a step counts for what is left of it; before the first sample the first is held.
        """
        offsets = (np.arange(num_steps + num_before) - num_before) * timestep
        shape = (len(which), len(offsets), self.recordings[0].ctrl.shape[1])
        each, owner, at = np.empty(shape), self.recording[which], self.in_steps(timestep)
        around = None
        if (at != np.floor(at)).any():
            around = np.empty((len(which), at.shape[1], shape[-1])), np.empty((len(which), at.shape[1], shape[-1]))
        for r in np.unique(owner):
            rows, record = np.flatnonzero(owner == r), self.recordings[r]
            begins = self.time[which[rows], :1] + offsets
            phase = (record.time - begins[0, 0]) / timestep
            if (np.abs(phase - np.rint(phase)) > TIME_SLACK).any():
                each[rows] = mean_commands(record, begins, begins + timestep)
            else:
                each[rows] = _held(record, begins, timestep)
            if around is not None:
                stamps = self.time[which[rows]]
                whole = self.time[which[rows], :1] + np.floor(at[which[rows]]) * timestep
                around[0][rows] = mean_commands(record, whole, stamps)
                around[1][rows] = _held(record, stamps, timestep)
        return Commands(each, around)


def snapped(at: Float[np.ndarray, "rows times"]) -> Float[np.ndarray, "rows times"]:
    """Times in steps, those on a step as whole numbers."""
    nearest = np.rint(at)
    return np.where(np.abs(at - nearest) < TIME_SLACK * 10, nearest, at)


def _held(record: Recording, time: Float[np.ndarray, "rows times"], timestep: float) -> np.ndarray:
    """Commands in force from some times on."""
    held = np.searchsorted(record.time, time + TIME_SLACK * timestep, side="right") - 1
    return record.ctrl[np.clip(held, 0, None)]


def mean_commands(
    recording: Recording, begins: Float[np.ndarray, "rows times"], ends: Float[np.ndarray, "rows times"]
) -> Float[np.ndarray, "rows times ctrl"]:
    """Means of the held commands over intervals, by their integral."""
    low, high = begins.min() - 1.0, ends.max() + 1.0
    time = np.concatenate([[min(low, recording.time[0])], recording.time, [max(high, recording.time[-1])]])
    ctrl = np.concatenate([recording.ctrl[:1], recording.ctrl])
    integral = np.concatenate([np.zeros((1, ctrl.shape[1])), np.cumsum(ctrl * np.diff(time)[:, None], axis=0)])
    length = np.maximum(ends - begins, np.finfo(float).tiny)
    out = np.empty((*begins.shape, ctrl.shape[1]))
    for j in range(ctrl.shape[1]):
        out[..., j] = (np.interp(ends, time, integral[:, j]) - np.interp(begins, time, integral[:, j])) / length
    return out


def all_columns(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Every column that some recording has, in order of first appearance."""
    return tuple(dict.fromkeys(column for record in recordings for column in record.columns))


def cut(
    recordings: Sequence[Recording], num_samples: int | None = None, columns: tuple[str, ...] | None = None
) -> Segments:
    """Recordings cut into stretches of about `num_samples` samples; None leaves each whole.

    Neighbours share no sample. A recording is halved, its halves too ..., so that longer stretches begin where shorter
    ones do, and no short rest is left over.
    """
    columns = all_columns(recordings) if columns is None else columns
    pieces: list[tuple[int, int, int]] = []
    for r, record in enumerate(recordings):
        length = len(record.time)
        parts = 1 if num_samples is None else 2 ** max(0, round(np.log2(length / num_samples)))
        edges = np.linspace(0, length, parts + 1).round().astype(int)
        pieces += [(r, int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a >= 2]
    return from_pieces(recordings, pieces, columns)


def from_pieces(
    recordings: Sequence[Recording], pieces: Sequence[tuple[int, int, int]], columns: tuple[str, ...], every: int = 1
) -> Segments:
    """Segments from (recording, first sample, sample after the last) triples, `every`-th samples of them."""
    longest = max(len(range(a, b, every)) for _, a, b in pieces)
    time = np.empty((len(pieces), longest))
    values = np.full((len(pieces), longest, len(columns)), np.nan)
    for s, (r, a, b) in enumerate(pieces):
        record, count = recordings[r], len(range(a, b, every))
        time[s, :count], time[s, count:] = record.time[a:b:every], record.time[a:b:every][-1]
        for j, column in enumerate(record.columns):
            if column in columns:
                values[s, :count, columns.index(column)] = record.values[a:b:every, j]
    index = np.array(pieces)
    return Segments(tuple(recordings), columns, index[:, 0], index[:, 1], time, values)
