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
from det2stoc_bayes.engines.layout import HINGE, SLIDE
from det2stoc_bayes.engines.state_columns import quaternion_address
from det2stoc_bayes.problem import Problem

if TYPE_CHECKING:
    import mujoco

    import det2stoc_bayes.linearization

# Samples from a segment's start, starts kept then, steps before: valleys look alike over the first samples.
STAGES = ((8, 12, 6), (12, 8, 6), (20, 5, 6), (40, 2, 6), (80, 1, 6))
STEPS_BEYOND = 3  # with the one start that is left, at every doubling up to the whole segment
NUM_STARTS, NUM_TURNED = 16, 32  # tried for each segment; where an orientation is unseen
SPINS = 1.5  # spreads of an orientation's speed
SHORTER = 0.3  # of a step that is no improvement
FARTHEST_TURN = 0.5  # rad in one step, or by its change of speed over the samples, of a turn that no column records

type Linearize = Callable[..., "Sequence[det2stoc_bayes.linearization.Linearization | None]"]


def search_starts(
    problem: Problem,
    z: Float[np.ndarray, " size"],
    linearize: Linearize,
    shorter: "det2stoc_bayes.linearization.Linearization | None" = None,
    seed: int = 0,
) -> Start:
    """The guessed starts where every position was recorded; elsewhere starts that explain the first samples best.

    `linearize(requests)` takes (problem, z, start) triples and gives their linearizations in the starts. Starts of a
    fit to shorter stretches, or to the same, join the last ones: long stretches are followed by no other while psi is
    far off. Of another `seed`, others are tried.
    """
    guess = problem.guess
    if guess.seen.all():
        return guess.start
    starts = [problem.moved(guess.start, change) for change in _spread(problem, seed)]
    longest, known = problem.segments.time.shape[1], 0 if shorter is None else shorter.problem.segments.time.shape[1]
    doublings = max(int(np.ceil(np.log2(longest / STAGES[-1][0]))), 0)
    beyond = [(STAGES[-1][0] * 2 ** (k + 1), 1, STEPS_BEYOND) for k in range(doublings)]
    for samples, kept, steps in (*STAGES, *beyond):
        if shorter is not None and (samples > known or samples >= longest):
            starts, shorter = [*starts, _continued(shorter, problem, starts[0])], None
        descent = _Descent(_beginning(problem, samples), z, starts, linearize)
        for _ in range(steps):
            descent.step()
        descent.keep(kept)
        starts = descent.starts
    return starts[0]


def _continued(shorter: "det2stoc_bayes.linearization.Linearization", problem: Problem, otherwise: Start) -> Start:
    """The starts of a fit to shorter stretches where one begins with a segment; others elsewhere."""
    begins = zip(shorter.problem.segments.recording, shorter.problem.segments.first, strict=True)
    rows = {at: row for row, at in enumerate(begins)}
    found = [rows.get(at, -1) for at in zip(problem.segments.recording, problem.segments.first, strict=True)]
    both = [Start(*(getattr(shorter.point.start, a)[found] for a in ("qpos", "qvel", "act"))), otherwise]
    return _choose(both, np.array([int(row < 0) for row in found]))


def _beginning(problem: Problem, samples: int) -> Problem:
    """The same for the first samples of each segment."""
    whole = problem.segments
    n = min(samples, whole.time.shape[1])
    return replace(problem, segments=replace(whole, time=whole.time[:, :n], values=whole.values[:, :n]))


def _spread(problem: Problem, seed: int) -> Float[np.ndarray, "starts segments states"]:
    """Changes of the guessed starts, none first: positions that were not recorded, evenly over what they can be.

    So are speeds of orientations, by which a turning body looks quite different within a few samples.
    """
    model, guess = problem.simulator.model, problem.guess
    unseen = [(int(v), *_reach(model, int(v))) for v in np.flatnonzero(~guess.seen)]
    spins = [model.nv + v for v, *_ in unseen if _is_orientation(model, v)]
    unseen += [(v, -SPINS * guess.scale[v], SPINS * guess.scale[v]) for v in spins]
    count = NUM_TURNED if spins else NUM_STARTS
    change = np.zeros((count, problem.segments.count, 2 * model.nv))
    draws = qmc.Sobol(len(unseen), rng=seed).random(count)
    for column, (place, low, high) in zip(draws.T, unseen, strict=True):
        change[1:, :, place] = (low + (high - low) * column[1:])[:, None]
    return change


def _reach(model: "mujoco.MjModel", v: int) -> tuple[float, float]:
    """How far a coordinate may lie from the model's own position: its range, a whole turn, or a metre."""
    joint = int(model.dof_jntid[v])
    kind, q = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
    if kind in (HINGE, SLIDE) and model.jnt_limited[joint]:
        low, high = model.jnt_range[joint] - model.qpos0[q]
        return float(low), float(high)
    return (-np.pi, np.pi) if _turns(model, v) else (-1.0, 1.0)


def _farthest(problem: Problem) -> Float[np.ndarray, " states"]:
    """How far each coordinate may move in one step: where turns are not recorded a linearization reaches but so far."""
    model, time = problem.simulator.model, problem.segments.time
    turns = ~problem.guess.seen & np.array([_turns(model, v) for v in range(model.nv)])
    far = np.where(turns, FARTHEST_TURN, np.inf)
    return np.concatenate([far, far / max(float(np.median(time[:, -1] - time[:, 0])), 1e-9)])


def _turns(model: "mujoco.MjModel", v: int) -> bool:
    return int(model.jnt_type[model.dof_jntid[v]]) == HINGE or _is_orientation(model, v)


def _is_orientation(model: "mujoco.MjModel", v: int) -> bool:
    joint = int(model.dof_jntid[v])
    turn = quaternion_address(model, joint)
    return turn is not None and bool(v - model.jnt_dofadr[joint] >= turn - model.jnt_qposadr[joint])


class _Descent:
    """Gauss-Newton from several starts of every segment at once; a step that is no improvement is shortened."""

    def __init__(self, problem: Problem, z: np.ndarray, starts: list[Start], linearize: Linearize):
        self.problem, self.z, self.starts, self.linearize = problem, z, list(starts), linearize
        self.farthest = _farthest(problem)
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
            share = np.minimum(self.share[k], 1 / np.max(np.abs(self.way[k]) / self.farthest, axis=1, initial=1.0))
            self.tried[k] = self.problem.moved(self.starts[k], share[:, None] * self.way[k])

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
