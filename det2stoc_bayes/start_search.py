"""Initial states where some coordinate was not recorded: the best of several, judged by the first samples.

Sensors such as a gyroscope or an accelerometer see the state only through the dynamics, so that a descent from the
model's own position may end in another valley than the recording's.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.problem import Problem

if TYPE_CHECKING:
    import mujoco

    import det2stoc_bayes.optimize

NUM_SAMPLES = 20  # of each segment, from its start
NUM_STARTS = 16  # tried for each segment
NUM_KEPT = 4  # of them, by what two steps make of them
NUM_STEPS = 8
SHORTER = 0.3  # of a step that is no improvement

type Linearize = Callable[..., "Sequence[det2stoc_bayes.optimize.Linearization | None]"]


def search_starts(problem: Problem, z: Float[np.ndarray, " size"], linearize: Linearize) -> Start:
    """The guessed starts where every position was recorded; elsewhere starts that explain the first samples best.

    `linearize(requests)` takes (problem, z, start) triples and gives their linearizations in the starts.
    """
    guess = problem.guess
    if guess.seen.all():
        return guess.start
    n = min(NUM_SAMPLES, problem.segments.time.shape[1])
    whole = problem.segments
    short = replace(problem, segments=replace(whole, time=whole.time[:, :n], values=whole.values[:, :n]))
    starts = [problem.moved(guess.start, change) for change in _spread(problem)]
    descent = _Descent(short, z, starts, linearize)
    for number in range(NUM_STEPS):
        descent.step()
        if number == 1:
            descent.keep(NUM_KEPT)
    descent.keep(1)
    return descent.starts[0]


def _spread(problem: Problem) -> Float[np.ndarray, "starts segments states"]:
    """Changes of the guessed starts, none first: positions that were not recorded, evenly over what they can be."""
    model, seen = problem.simulator.model, problem.guess.seen
    unseen = np.flatnonzero(~seen)
    change = np.zeros((NUM_STARTS, problem.segments.count, 2 * model.nv))
    draws = qmc.Sobol(len(unseen), rng=0).random(NUM_STARTS)
    for column, v in zip(draws.T, unseen, strict=True):
        low, high = _reach(model, int(v))
        change[1:, :, v] = (low + (high - low) * column[1:])[:, None]
    return change


def _reach(model: "mujoco.MjModel", v: int) -> tuple[float, float]:
    """How far a coordinate may lie from the model's own position: its range, a whole turn, or a metre."""
    joint = int(model.dof_jntid[v])
    kind, q = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
    if kind in (2, 3) and model.jnt_limited[joint]:
        low, high = model.jnt_range[joint] - model.qpos0[q]
        return float(low), float(high)
    slides = kind == 2 or (kind == 0 and v - model.jnt_dofadr[joint] < 3)
    return (-1.0, 1.0) if slides else (-np.pi, np.pi)


class _Descent:
    """Gauss-Newton from several starts of every segment at once; a step that is no improvement is shortened."""

    def __init__(self, problem: Problem, z: np.ndarray, starts: list[Start], linearize: Linearize):
        self.problem, self.z, self.starts, self.linearize = problem, z, starts, linearize
        shape = (len(starts), problem.segments.count)
        self.tried = list(starts)
        self.height = np.full(shape, np.inf)
        self.share = np.ones(shape)
        self.way = np.zeros((*shape, problem.guess.scale.shape[0]))

    def step(self) -> None:
        """Judge what was tried, and try the next."""
        found = self.linearize([(self.problem, self.z, start) for start in self.tried])
        for k, lin in enumerate(found):
            height = np.full(self.height.shape[1], np.inf) if lin is None else (lin.stacked**2).sum((1, 2))
            better = height < self.height[k]
            if lin is not None:
                self.way[k][better] = lin.latent.best_start(lin.stacked)[better]
                self.starts[k] = _choose([self.starts[k], self.tried[k]], better.astype(int))
            self.height[k] = np.where(better, height, self.height[k])
            self.share[k] = np.where(better, 1.0, SHORTER * self.share[k])
            self.tried[k] = self.problem.moved(self.starts[k], self.share[k][:, None] * self.way[k])

    def keep(self, count: int) -> None:
        """Only the best of each segment."""
        order = np.argsort(self.height, axis=0)[:count]
        segments = np.arange(order.shape[1])
        self.starts = [_choose(self.starts, row) for row in order]
        self.tried = [_choose(self.tried, row) for row in order]
        self.height, self.share = self.height[order, segments], self.share[order, segments]
        self.way = self.way[order, segments]


def _choose(starts: Sequence[Start], which: Any) -> Start:
    """Of several starts the one that `which` says for each segment."""
    rows = np.arange(len(which))
    return Start(*(np.stack([getattr(s, a) for s in starts])[which, rows] for a in ("qpos", "qvel", "act")))
