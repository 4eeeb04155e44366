"""What contact does to a state's uncertainty: a floor holds a body, and an impact turns what is unknown into a jolt.

An observer that takes a body for a free mass believes its speed after an impact as firmly as before, and is wrong for
as long as its memory lasts. Simulations that are led along the same recording with noise drawn anew part at impacts;
their spread is the uncertainty that an ensemble Kalman filter would have there (Evensen, 2009, ch. 4).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.observer import ContactFlow, Observer, Places
from det2stoc_bayes.mismatch.contact.observers import make_observer, on_rows
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.segments import Segments

ENSEMBLE = 16  # members
SEED = 5
NUM_ROUNDS = 2  # in which gains and what contact does to uncertainty settle: what is made up for sooner jolts less
Made = tuple[Observer, Float[np.ndarray, "recordings samples columns"]]


class Once[T]:
    """What several threads ask for, by segments and memory: found by the first that asks, while others wait for it."""

    def __init__(self):
        self._lock, self._locks = Lock(), dict[tuple[int, float], Lock]()
        self._found: dict[tuple[int, float], tuple[Segments, T]] = {}  # with whose number is the key, or it is reused

    def __len__(self) -> int:
        return len(self._found)

    def __call__(self, segments: Segments, memory: float, make: Callable[[], T]) -> T:
        """What is known, or is made now."""
        key = id(segments), memory
        with self._lock:
            lock = self._locks.setdefault(key, Lock())
        with lock:
            if key not in self._found:
                self._found[key] = segments, make()
            return self._found[key][1]


@dataclass(frozen=True, eq=False)
class Ground:
    """A hypothesis at some unknowns, and what is believed of contact there: that it holds bodies, and how it jolts."""

    problem: Problem
    z: Float[np.ndarray, " size"]
    holds: bool = False
    share: float = 1.0  # of the jolts
    made: Once[Made] = field(default_factory=Once)
    first: Once[ContactFlow] = field(default_factory=Once)  # of a first round

    def regarding(self, holds: bool, share: float) -> "Ground":
        """The same with other beliefs of contact; what does not depend on them is shared."""
        return replace(self, holds=holds, share=share, made=Once())

    def observer(self, segments: Segments, memory: float) -> Made:
        """The observer of some recordings, as `make_observer` has it, found once for all hypotheses."""
        return self.made(segments, memory, lambda: self._found(segments, memory))

    def _found(self, segments: Segments, memory: float) -> Made:
        problem = self.problem.on(segments)
        z = self.problem.carry(self.z, problem)
        made = make_observer(problem, memory)
        first = self.first(segments, memory, lambda: contact_flow(problem, made[0], z))
        for k in range(NUM_ROUNDS):
            flow = contact_flow(problem, made[0], z) if k else first
            kept = flow.kept if self.holds else np.ones_like(flow.kept)
            made = make_observer(problem, memory, ContactFlow(kept, self.share * flow.grown))
        return made


def contact_flow(problem: Problem, observer: Observer, z: Float[np.ndarray, " size"]) -> ContactFlow:
    """What contact does to the variances of positions and speeds up to each sample, at a hypothesis' unknowns."""
    free, foretold = (_variance(x, problem.segments.count) for x in _members(problem, observer, z))
    kept = np.ones((len(free), problem.segments.time.shape[1], *free.shape[2:]))
    with np.errstate(divide="ignore", invalid="ignore"):
        kept[:, 1:] = np.where(foretold < free, foretold / free, 1.0)
    kept[..., 0] = np.where(observer.seen[..., 0], kept[..., 0], 1.0)
    grown = np.zeros(kept.shape[:-1])
    grown[:, 1:] = np.maximum(foretold[..., 1] - free[..., 1], 0.0)
    return ContactFlow(kept, grown)


def _members(
    problem: Problem, observer: Observer, z: Float[np.ndarray, " size"]
) -> tuple[Float[np.ndarray, "rows intervals nv 2"], Float[np.ndarray, "rows intervals nv 2"]]:
    """Places, beside the first member's, and speeds at each sample of members led with noise anew.

    First as a free motion from the sample before would have them, then as simulated; NaN of what diverged.
    """
    rows = np.tile(np.arange(problem.segments.count), ENSEMBLE)
    many = on_rows(problem, rows)
    noise = problem.noise * np.random.default_rng(SEED).standard_normal(many.segments.values.shape)
    members = Observer(observer.gains[rows], observer.values[rows] + noise, observer.seen[rows])
    path = problem.simulator.engine.trajectory(replace(many.request(z[None], many.guess.start), observer=members))
    places, flat = Places(problem.simulator.model, many.segments.columns), (-1, path.columns.shape[-1])

    def apart(values: np.ndarray) -> np.ndarray:
        e = places.errors(path.columns.reshape(flat), values.reshape(flat)).reshape(members.seen.shape)
        return np.where(members.seen, e, 0.0)

    change = np.einsum("rsvij,rsvj->rsvi", members.gains, apart(members.values))
    place = -apart(path.columns[rows])[..., 0]
    free = np.stack([place + change[..., 0], path.qvel], -1)[:, :-1]
    free[..., 0] += np.diff(many.segments.time, axis=1)[..., None] * free[..., 1]
    foretold = np.stack([place, path.qvel - change[..., 1]], -1)[:, 1:]
    diverged = ~np.isfinite(path.columns).all((1, 2))
    free[diverged], foretold[diverged] = np.nan, np.nan
    return free, foretold


def _variance(rows: Float[np.ndarray, "rows *rest"], count: int) -> Float[np.ndarray, "recordings *rest"]:
    """Over members, of each recording; 0 where fewer than two did not diverge."""
    members = rows.reshape(ENSEMBLE, count, *rows.shape[1:])
    there = np.isfinite(members)
    number, values = there.sum(0), np.where(there, members, 0.0)
    square = np.where(there, (values - values.sum(0) / np.maximum(number, 1)) ** 2, 0.0).sum(0)
    return np.where(number > 1, square / np.maximum(number - 1, 1), 0.0)
