"""What recorded columns show of simulated states: sensors that are late, biased or scaled among them."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.engines.base import EffectRows
from det2stoc_bayes.engines.layout import ColumnAddress
from det2stoc_bayes.segments import Segments

# Some numbers of an array, (source, indices, simulations, steps from the start (rows, samples)) -> (rows, samples, _)
type Between = Callable[[str, Sequence[int] | np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Readings:
    """Columns of simulations, each of which follows segment `which` by steps of `dt` seconds."""

    def __init__(
        self,
        segments: Segments,
        which: Int[np.ndarray, " sims"],
        addresses: Sequence[ColumnAddress],
        effects: Sequence[EffectRows],
        dt: float,
    ):
        self.segments, self.which, self.dt = segments, which, dt
        sensors = [e for e in effects if e.placed.element.kind == "sensor"]
        # Columns by the array that they are read from, and those of sensors with effects one by one.
        plain: dict[str, list[tuple[int, int]]] = {}
        self._sensed: list[tuple[int, ColumnAddress, list[EffectRows]]] = []
        for j, (column, address) in enumerate(zip(segments.columns, addresses, strict=True)):
            if mine := [e for e in sensors if e.placed.element.column in (column, "time")]:
                self._sensed.append((j, address, mine))
            else:
                plain.setdefault(address.source, []).append((j, address.index))
        self.straight = not self._sensed  # whether columns are numbers of the state as it is
        self._plain = {source: np.array(here).T for source, here in plain.items()}

    def at_once(self, states: Mapping[str, Float[np.ndarray, "rows _"]]) -> Float[np.ndarray, "rows columns"]:
        """A sample of simulations from their states at its time, where columns are `straight`."""
        out = np.empty((len(next(iter(states.values()))), len(self.segments.columns)))
        for source, (columns, numbers) in self._plain.items():
            out[:, columns] = states[source][:, numbers]
        return out

    def of(
        self, between: Between, rows: Int[np.ndarray, " rows"], samples: slice
    ) -> Float[np.ndarray, "rows samples columns"]:
        """Some samples of some simulations, from states that `between` tells."""
        stamps = self.segments.time[self.which[rows], samples]
        begin = self.segments.time[self.which[rows], 0]
        out = np.empty((*stamps.shape, len(self.segments.columns)))
        at = (stamps - begin[:, None]) / self.dt
        for source, (columns, numbers) in self._plain.items():
            out[:, :, columns] = between(source, numbers, rows, at)
        for j, address, effects in self._sensed:
            mine, times = [self._inside(e, rows) for e in effects], np.array(stamps)
            for effect, there, parameters in mine:
                if effect.uses("sample_time"):
                    times[there] = effect.sample_time(parameters, times[there], np)
            at = (times - begin[:, None]) / self.dt
            out[:, :, j] = between(address.source, [address.index], rows, at)[..., 0]
            for effect, there, parameters in mine:
                if effect.uses("reading"):
                    out[there, :, j] = effect.reading(parameters, stamps[there], out[there, :, j], np)
        return out

    @staticmethod
    def _inside(e: EffectRows, rows: Int[np.ndarray, " rows"]):
        """The effect, in which of the rows it acts, and its parameters there."""
        there = np.flatnonzero((rows >= e.rows.start) & (rows < e.rows.stop))
        parameters = {name: values[rows[there] - e.rows.start] for name, values in e.parameters.items()}
        return e.placed.effect, there, parameters
