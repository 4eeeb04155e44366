"""What a small change does to what a led simulation foretells, to first order.

From sample to sample it is carried on as along a free trajectory, and at each sample the observer takes a share of it
back. So no history of forces costs a simulation of its own. Where contact is made or broken the slopes of two sides
have nothing in common, and count for as little as they do for unknowns.
"""

from collections.abc import Sequence
from dataclasses import replace
from threading import RLock

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.observer import Places
from det2stoc_bayes.linearization import START_STEP, Point
from det2stoc_bayes.mismatch.changes import Values, of_motion
from det2stoc_bayes.mismatch.contact.differences import steady
from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.followed import FARTHEST
from det2stoc_bayes.mismatch.contact.observers import sds_of_starts
from det2stoc_bayes.mismatch.effects.base import PlacedEffect
from det2stoc_bayes.mismatch.probes import Probe
from det2stoc_bayes.mismatch.response import Response

UNSEEN = 0.1  # of its spread, which may be half a turn: as far as a coordinate that nothing shows is moved
WIDER = {"dof": 10.0, "gravity": 100.0, "wind": 20.0}  # times a free trajectory's steps: past a contact's kink


class LedResponse(Response):
    """The linear time-varying system along a fit's led simulations, one a recording; threads may share it.

    Where the hypothesis has a sensor's effect, the observer is taken to see what moves, not what is read of it.
    """

    def __init__(self, fit: ContactFit):
        plain = fit.as_believed.followed
        self._followed, self._finding = plain, RLock()  # what several threads share is found by one
        self._places = Places(plain.problem.simulator.model, plain.problem.segments.columns)
        request = replace(plain.problem.request(fit.z[None], plain.start), observer=plain.observer)
        self._set_out(plain.problem, Point(fit.z, plain.start), request)
        self._left = plain.problem.residuals(self.path.columns)

    def _linearize(self) -> None:
        """Over as far as a state is known, to both sides."""
        problem, model = self.problem, self.problem.simulator.model
        noise = self._places.noise(problem.noise)
        known = np.where(np.isfinite(noise), 1.0, UNSEEN) * sds_of_starts(problem, noise)
        steps = np.concatenate([known.T.ravel(), np.full(model.na, START_STEP)])
        requests = [self._request(self.begin)]
        for i, sign in ((i, sign) for i in range(self.state_size) for sign in (1.0, -1.0)):
            change = np.zeros((len(self.pieces), self.state_size))
            change[:, i] = sign * steps[i]
            requests.append(self._request(self._moved(change)))
        state, column, self._origin = self._run(requests)
        self._column = column[0]

        def slopes(ends: Float[np.ndarray, "variants pieces k"]) -> np.ndarray:
            up, down = (ends[k::2] - ends[0] for k in (1, 2))
            return np.moveaxis(steady(np.nan_to_num(up), -np.nan_to_num(down)), 0, -1) / steps

        self.a, self.c = self._spread(slopes(state)), self._spread(slopes(column))

    def _unit(self, probe: Probe, step: float) -> tuple[np.ndarray, np.ndarray]:
        """What pushes and pulls by a wider step to either side."""
        with self._finding:
            wider = WIDER.get(probe.key[0])
            if wider is None:
                return super()._unit(probe, step)
            if probe.key not in self._units:
                wide = wider * step
                both = self.defects([(probe.placed, probe.values(size)) for size in (wide, -wide)])
                d, e = (steady(x[..., 0], -x[..., 1]) / wide for x in both)
                self._units[probe.key] = d, e
            return self._units[probe.key]

    def propagate(self, d: np.ndarray, e: np.ndarray) -> Float[np.ndarray, "S values columns"]:
        """Change of what is foretold (flat over samples and columns) that is caused by defects."""
        return self._carried(d, e, np.broadcast_to(0.0, (*self.path.qvel.shape, 2, d.shape[-1])))

    def _carried(
        self, d: np.ndarray, e: np.ndarray, misread: Float[np.ndarray, "S samples nv 2 columns"]
    ) -> Float[np.ndarray, "S values columns"]:
        """The same where the observer takes coordinates for others than they are."""
        count, intervals = self.shape
        nv, gains = self.problem.simulator.model.nv, self._followed.observer.gains
        state = np.zeros((count, self.state_size, d.shape[-1]))
        out = np.zeros((count, intervals + 1, e.shape[2], d.shape[-1]))
        for k in range(intervals):
            out[:, k + 1] = self.c[:, k] @ state + e[:, k]
            state = self.a[:, k] @ state + d[:, k]
            seen = np.stack([state[:, :nv], state[:, nv : 2 * nv]], 2) + misread[:, k + 1]
            back = np.einsum("svij,svjc->sivc", gains[:, k + 1], seen)
            state[:, : 2 * nv] -= back.reshape(count, 2 * nv, -1)
        return out.reshape(count, -1, d.shape[-1])

    def lessened(
        self, placed: PlacedEffect, tried: Sequence[Values]
    ) -> Float[np.ndarray, "blocks samples columns values"]:
        """By how much an effect of each of these parameter values would lessen the errors."""
        reads, shape = placed.effect.uses("reading"), self.path.columns.shape
        found = self._misread(placed, tried) if reads else of_motion(self, placed, tried)
        moved = np.moveaxis(found, -1, 0).reshape(len(tried), *shape)
        with np.errstate(all="ignore"):
            after = self.problem.residuals((self.path.columns + moved).reshape(-1, *shape[1:]))
            change = self._left - after.reshape(len(tried), *self._left.shape)
            change = self._followed.in_blocks(change.reshape(-1, *shape[1:]))
        told = np.isfinite(change) & (np.abs(change) < FARTHEST)  # a simulation that diverges tells nothing
        return np.moveaxis(np.where(told, change, 0.0), 0, -1)

    @property
    def held(self) -> int:
        """Numbers that a column of what changes takes."""
        return int(np.prod(self.path.qpos.shape[:2])) * max(self.path.columns.shape[-1], self.state_size)

    def _misread(self, placed: PlacedEffect, tried: Sequence[Values]) -> Float[np.ndarray, "S values columns"]:
        """What a sensor's effect changes: what is read, and where the observer then leads the simulation."""
        segments, plain = self.problem.segments, self.path.columns
        j, flat = segments.columns.index(placed.element.column), (-1, plain.shape[-1])
        observed = self._followed.observer.values.reshape(flat)

        def errors(columns: np.ndarray) -> np.ndarray:
            return self._places.errors(columns.reshape(flat), observed).reshape(*self.path.qvel.shape, 2)

        before, columns, misread = errors(plain), np.zeros((*plain.shape, len(tried))), []
        for i, values in enumerate(tried):
            given = {n: np.full(segments.count, v) for n, v in values.items()}
            columns[..., j, i] = placed.effect.reading(given, segments.time, plain[..., j], np) - plain[..., j]
            misread.append(before - errors(plain + columns[..., i]))
        still = np.zeros((*self.shape, self.state_size, len(tried)))
        return self._carried(still, columns[:, 1:], np.stack(misread, -1))


def foretells(placed: PlacedEffect) -> bool:
    """Whether first order says what an effect changes; contact's own, and what is read late, are simulated."""
    return placed.element.kind != "contact" and not placed.effect.uses("sample_time")
