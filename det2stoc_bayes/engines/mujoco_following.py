"""Simulations in C that an observer leads along recorded samples.

Python has a part at every sample alone, which is half of the time: where samples lie on steps, and columns are numbers
of the state, nothing is kept of what is between.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.engines.base import Trajectory
from det2stoc_bayes.engines.observer import Places, corrected
from det2stoc_bayes.segments import TIME_SLACK

if TYPE_CHECKING:
    from det2stoc_bayes.engines.mujoco_chunk import Chunk
    from det2stoc_bayes.engines.mujoco_steps import Stepper


FARTHEST = 1e6  # SI units: an error beyond it leads nothing


class Follower:
    """A chunk, led; unless it is `light` with states at every step, before (`ahead`) and after (`led`) correction."""

    def __init__(self, chunk: "Chunk", ctrl: np.ndarray, stepper: "Stepper | None"):
        self.chunk, self.ctrl, self.stepper = chunk, ctrl, stepper
        self.model, self.batch = chunk.model, chunk.batch
        segments, observer = chunk.segments, chunk.request.observer
        assert observer is not None
        self.gains = observer.gains[chunk.which]
        self.seen, self.drawn = observer.seen[chunk.which], observer.drawn
        self.places = Places(self.model, segments.columns)
        values = observer.values if self.drawn else self.places.unit(observer.values)
        self.values, self.told = values[chunk.which], observer.gains.any((0, 2, 3, 4))
        self.at = segments.in_steps(chunk.dt)[chunk.which]
        self.step = np.ceil(self.at - TIME_SLACK).astype(int)  # the first one that is not before the sample
        sources = {a.source for a in chunk.addresses}
        self.sensors = "sensordata" in sources
        names = ["qpos", "qvel", *(["act"] if self.model.na else []), *(["sensordata"] if self.sensors else [])]
        self.live = {n: self.batch.bind(n) for n in names}
        on_steps = np.abs(self.at - self.step).max(initial=0.0) <= TIME_SLACK
        self.light = bool(on_steps and not self.sensors and chunk.readings.straight)
        count = 0 if self.light else chunk.num_steps + 1
        self.led = {n: np.empty((chunk.count, count, a.shape[1])) for n, a in self.live.items()}
        self.ahead = {n: np.empty_like(a) for n, a in self.led.items()}

    def run(self) -> Trajectory:
        """Predictions of every sample from those before it, and the states after its correction."""
        chunk = self.chunk
        rows, samples = self.at.shape
        columns = np.full((rows, samples, len(chunk.addresses)), np.nan)
        states = {n: np.zeros((rows, samples, self.live[n].shape[1])) for n in self.live if n != "sensordata"}
        self._keep(0)
        new = np.diff(self.at, axis=1, prepend=-1.0) > 0
        for step in np.unique(self.step[new]):  # in their order, whatever the samples' numbers: grids may differ
            self._advance(int(step))
            there = new & (self.step == step)
            for j in np.flatnonzero(there.any(0)):
                mine = slice(None) if there[:, j].all() else np.flatnonzero(there[:, j])
                (self._lead_lightly if self.light else self._lead)(int(j), mine, columns, states)
        self._advance(chunk.num_steps)
        for j in range(1, samples):
            same = ~new[:, j]
            columns[same, j] = columns[same, j - 1]
            for a in states.values():
                a[same, j] = a[same, j - 1]
        columns[chunk.failed()] = np.nan
        columns[~np.isfinite(columns).all((1, 2)) | (np.abs(columns).max((1, 2)) > 1e9)] = np.nan
        empty = np.empty((*columns.shape[:2], 0))
        return Trajectory(columns, states["qpos"], states["qvel"], states.get("act", empty))

    def _keep(self, step: int) -> None:
        self.done = step
        if self.light:
            return
        if self.sensors:
            self.batch.forward()
        for n, a in self.live.items():
            self.ahead[n][:, step] = a
            self.led[n][:, step] = a

    def _advance(self, step: int) -> None:
        """Simulate up to a step."""
        begin = self.done
        if step <= begin:
            return
        ctrl = self.ctrl[:, begin : step + 1]
        items = [n for n in self.live if n != "sensordata"]
        wanted = () if self.light else sorted(self.live)
        if self.stepper is not None:
            record = self.stepper.run(ctrl, wanted, closing=self.sensors)
        else:
            record = self.chunk.roll(ctrl, wanted)
        self.done = step
        if self.light:
            return
        for n in items:
            self.ahead[n][:, begin + 1 : step + 1] = record[n]
            self.led[n][:, begin + 1 : step + 1] = record[n]
        if self.sensors:
            self.ahead["sensordata"][:, begin:step] = record["sensordata"]
            self.led["sensordata"][:, begin:step] = record["sensordata"]
            self.batch.forward()
            self.ahead["sensordata"][:, step] = self.led["sensordata"][:, step] = self.live["sensordata"]

    def _error(
        self, j: int, rows: Int[np.ndarray, " rows"] | slice, predicted: Float[np.ndarray, "rows columns"]
    ) -> Float[np.ndarray, "rows nv 2"]:
        """Of what is seen of sample j; none of a simulation that has gone astray."""
        values = self.places.unit(self.values[rows, j] + predicted) if self.drawn else self.values[rows, j]
        error = self.places.apart(predicted, values)
        return np.where(self.seen[rows, j] & (np.abs(error) < FARTHEST), error, 0.0)

    def _lead_lightly(self, j: int, rows: Int[np.ndarray, " rows"] | slice, columns: np.ndarray, states: dict) -> None:
        """`_lead` of a sample on the step that was simulated last."""
        there = {n: self.live[n][rows] for n in states}
        predicted = self.chunk.readings.at_once(there)
        columns[rows, j] = predicted
        for n, value in there.items():
            states[n][rows, j] = value
        if not self.told[j]:
            return
        place, push = corrected(self.model, there["qpos"], self.gains[rows, j], self._error(j, rows, predicted))
        states["qpos"][rows, j] = place
        states["qvel"][rows, j] += push
        self._correct(rows, place, push)

    def _lead(self, j: int, rows: Int[np.ndarray, " rows"] | slice, columns: np.ndarray, states: dict) -> None:
        """Read off sample j of some simulations, and correct their states by it."""
        rows = np.arange(len(self.at))[rows]
        at = self.at[rows, j]
        columns[rows, j] = self.chunk.readings.of(self._read, rows, slice(j, j + 1))[:, 0]
        error = self._error(j, rows, columns[rows, j])
        gain = self.gains[rows, j]
        there = {n: self._between(n, rows, at) for n in states}
        place, push = corrected(self.model, there["qpos"], gain, error)
        for n, value in {**there, "qpos": place, "qvel": there["qvel"] + push}.items():
            states[n][rows, j] = value
        if not gain.any():
            return
        now = self.live["qpos"][rows]
        moved, push = (place, push) if np.array_equal(now, there["qpos"]) else corrected(self.model, now, gain, error)
        self._correct(rows, moved, push)
        for n in ("qpos", "qvel"):
            self.led[n][rows, self.done] = self.live[n][rows]

    def _correct(self, rows: Int[np.ndarray, " rows"] | slice, place: np.ndarray, push: np.ndarray) -> None:
        """Where simulations go on from: their corrected positions, and speeds changed by a push."""
        self.live["qpos"][rows] = place
        self.live["qvel"][rows] += push
        if self.stepper is not None:
            self.stepper.past[rows] += push

    def _read(
        self, name: str, indices: Sequence[int] | np.ndarray, rows: np.ndarray, at: Float[np.ndarray, "rows one"]
    ) -> np.ndarray:
        return self._between(name, rows, at[:, 0])[:, None, indices]

    def _between(self, name: str, rows: np.ndarray, at: Float[np.ndarray, " rows"]) -> np.ndarray:
        """The state at a time in steps, as foretold from what was before."""
        if np.abs(at - self.done).max() <= TIME_SLACK:  # as most samples are
            return self.ahead[name][rows, self.done]
        low = np.clip(np.ceil(at - TIME_SLACK).astype(int) - 1, 0, max(self.done - 1, 0))
        share = (at - low)[:, None]
        high = np.minimum(low + 1, self.done)
        return (1 - share) * self.led[name][rows, low] + share * self.ahead[name][rows, high]
