"""The most likely unknowns of a hypothesis on windows, and the windows' starts beside them, by Gauss-Newton steps.

A few windows make or break a contact, where a derivative is a thousand times the others': finite differences are wide,
errors are Student-t, and a step is kept only if the likelihood itself, which needs no derivative, says so; a window's
start moves along only where that tells the window better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.mismatch.contact.beside_starts import BesideStarts
from det2stoc_bayes.mismatch.contact.scales import Scales, scales_of, scatter
from det2stoc_bayes.mismatch.contact.window_starts import away, start_sd
from det2stoc_bayes.mismatch.contact.windows import Windows
from det2stoc_bayes.problem import repeat_start

STEP = 0.5  # prior sds to either side: a finite difference over which contact is smooth enough
AGREE = 0.3  # relative difference of the slopes to either side beyond which a sensitivity is chaos
FRACTIONS = (3.0, 1.0, 0.3, 0.1)  # of a step
LARGEST_STEP = 2.0  # prior sds at once
FARTHEST_MOVE = 3.0  # sds of a recorded start at once
ITERATIONS = 8
SETTLED = 0.2  # nats
FARTHEST = 5.0  # prior sds of psi from its median


@dataclass(frozen=True, eq=False)
class WindowFit:
    """A hypothesis at its most likely unknowns; `near`: sensitivities to starts of a fit nearby, which serve here."""

    windows: Windows
    z: Float[np.ndarray, " size"]
    errors: Float[np.ndarray, "windows horizons columns"]
    scales: Scales
    near: Float[np.ndarray, "windows horizons columns states"] | None = None

    @property
    def problem(self):
        """The hypothesis."""
        return self.windows.problem

    def only(self, rows: Int[np.ndarray, " rows"]) -> "WindowFit":
        """The same on some of the windows, under the scales of all."""
        return replace(self, windows=self.windows.only(rows), errors=self.errors[rows], near=self.start_columns[rows])

    @cached_property
    def away(self) -> Float[np.ndarray, "windows states"]:
        """How far the starts stand from the recorded ones, in sds of these."""
        return away(self.windows)

    @cached_property
    def columns(self) -> Float[np.ndarray, "windows horizons columns size"]:
        """Sensitivities of the prediction to the unknowns, in noise sds."""
        return _columns(self.windows, self.z, self.errors)

    @cached_property
    def start_columns(self) -> Float[np.ndarray, "windows horizons columns states"]:
        """The same to each window's start, for one sd of a recorded one."""
        return _start_columns(self.windows, self.z, self.errors) if self.near is None else self.near

    @cached_property
    def losses(self) -> Float[np.ndarray, " windows"]:
        """-log likelihood of each window from its start."""
        return self.scales.losses(self.errors)

    @cached_property
    def heights(self) -> Float[np.ndarray, " windows"]:
        """The same and that of its start."""
        return self.losses + self.strange

    @cached_property
    def strange(self) -> Float[np.ndarray, " windows"]:
        """-log density of each window's start, as the measurement of its first sample has it."""
        return 0.5 * (self.away**2).sum(1)

    @property
    def loss(self) -> float:
        """-log posterior, up to a constant."""
        return float(self.heights.sum() + 0.5 * self.z @ self.z)

    @cached_property
    def beside(self) -> BesideStarts:
        """Least squares beside the starts."""
        return BesideStarts(self.scales.weights(self.errors), self.start_columns, self.away)

    @cached_property
    def told(self) -> Float[np.ndarray, "windows values size"]:
        """Sensitivities to the unknowns that no start makes up for."""
        return self.beside.columns(self.columns)

    @cached_property
    def left(self) -> Float[np.ndarray, "windows values"]:
        """Errors that no start explains."""
        return self.beside.errors(self.errors)

    @cached_property
    def gram(self) -> Float[np.ndarray, "size size"]:
        """Curvature of the log posterior."""
        return np.einsum("wnk,wnl->kl", self.told, self.told) + np.eye(len(self.z))

    @cached_property
    def slopes(self) -> Float[np.ndarray, "windows size"]:
        """Each window's pull on the unknowns."""
        return np.einsum("wnk,wn->wk", self.told, self.left)

    @cached_property
    def covariance(self) -> Float[np.ndarray, "size size"]:
        """Of the unknowns: the sandwich of curvature and scatter over windows, the prior being one more observation."""
        inverse = np.linalg.inv(self.gram)
        return inverse @ (scatter(self.slopes, self.windows.recording) + np.eye(len(self.z))) @ inverse


def steady(up: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Slopes as far as those to either side agree: where contact is chaotic they have nothing in common."""
    size = np.abs(up) + np.abs(down)
    apart = np.divide(np.abs(up - down), size, out=np.zeros_like(size), where=size > 0)
    return 0.5 * (up + down) / (1 + (apart / AGREE) ** 4)


def fit_windows(
    windows: Windows,
    z: Float[np.ndarray, " size"] | None = None,
    *,
    held: Sequence[int] = (),
    iterations: int = ITERATIONS,
    others: Sequence[np.ndarray] = (),
    near: Float[np.ndarray, "windows horizons columns states"] | None = None,
    moves: Float[np.ndarray, "windows states"] | None = None,
) -> WindowFit:
    """The most likely unknowns and starts from `z`, or from the best of it and `others`; those `held` stay.

    near: sensitivities to the starts. moves: a change of the starts, in their sds, that each window may take at first.
    """
    tried = np.stack([np.zeros(windows.problem.size) if z is None else np.array(z, float), *others])
    moves = np.zeros((windows.count, 2 * windows.problem.simulator.model.nv)) if moves is None else moves
    best = _best(windows, tried, np.stack([moves] * len(tried)))
    fit = WindowFit(best.windows, best.z, best.errors, scales_of(best.errors), near)
    for _ in range(iterations):
        step = _step(fit, held)
        along = fit.beside.moves(fit.errors - fit.columns @ step)
        ways = np.stack([np.clip(f * along, -FARTHEST_MOVE, FARTHEST_MOVE) for f in FRACTIONS])
        best = _best(fit.windows, np.stack([_within(fit, fit.z + f * step) for f in FRACTIONS]), ways, fit.scales)
        gain = fit.loss - best.height
        if not gain > 0:
            break
        fit = WindowFit(best.windows, best.z, best.errors, scales_of(best.errors), fit.start_columns)
        if gain < SETTLED:
            break
    return fit


class _Tried(NamedTuple):
    height: float
    windows: Windows
    z: np.ndarray
    errors: np.ndarray


def _best(windows: Windows, z: np.ndarray, moves: np.ndarray, scales: Scales | None = None) -> _Tried:
    """The likeliest of these unknowns, each window's start moved where that tells it better."""
    problem, count = windows.problem, len(z)
    start, sd, here = problem.guess.start, start_sd(problem), away(windows)
    there = problem.moved(repeat_start(start, count), (moves * sd).reshape(-1, len(sd)))
    stay = windows.errors(z)
    move = windows.errors(z, there) if moves.any() else stay
    out = []
    for k in range(count):
        common = scales_of(stay[k]) if scales is None else scales
        near, far = 0.5 * (here**2).sum(1), 0.5 * ((here + moves[k]) ** 2).sum(1)
        better = common.losses(move[k]) + far < common.losses(stay[k]) + near
        errors = np.where(better[:, None, None], move[k], stay[k])
        strange = float(np.where(better, far, near).sum())
        height = float(scales_of(errors).losses(errors).sum() + strange + 0.5 * z[k] @ z[k])
        out.append((height, k, better, errors))
    height, k, better, errors = min(out, key=lambda t: t[0])
    mine = there[k * windows.count : (k + 1) * windows.count]
    return _Tried(height, windows.starting(start.taking(mine, better)) if better.any() else windows, z[k], errors)


def at(windows: Windows, z: Float[np.ndarray, " size"], scales: Scales | None = None) -> WindowFit:
    """The hypothesis at given unknowns and starts, under scales that may be given."""
    z = np.asarray(z, float)
    errors = windows.errors(z[None])[0]
    return WindowFit(windows, z, errors, scales_of(errors) if scales is None else scales)


def _columns(windows: Windows, z: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """By finite differences; values of different recordings are moved together."""
    problem = windows.problem
    probes = problem.probes()
    moved, steps = np.tile(z, (2 * len(probes), 1)), []
    for k, which in enumerate(probes):
        steps.append(abs(problem.nudge(z, which, STEP)))
        moved[2 * k, which] += steps[-1]
        moved[2 * k + 1, which] -= steps[-1]
    moved = np.maximum(moved, problem.floor)
    columns = np.zeros((*errors.shape, problem.size))
    found = windows.errors(moved) if probes else []
    for k, (which, step) in enumerate(zip(probes, steps, strict=True)):
        up, down = (np.nan_to_num(x) for x in ((errors - found[2 * k]) / step, (found[2 * k + 1] - errors) / step))
        below = moved[2 * k + 1, which[0]] > z[which[0]] - 0.5 * step  # at the wall there is one side only
        change = up if below else steady(up, down)
        if len(which) == 1:
            columns[..., which[0]] = change
            continue
        for r, i in enumerate(which):
            mine = windows.recording == r
            columns[mine, :, :, i] = change[mine]
    return columns


def _start_columns(windows: Windows, z: np.ndarray, errors: np.ndarray) -> np.ndarray:
    problem, sd = windows.problem, start_sd(windows.problem)
    states = len(sd)
    change = np.zeros((2 * states, windows.count, states))
    for i in range(states):
        change[2 * i, :, i], change[2 * i + 1, :, i] = sd[i], -sd[i]
    start = problem.moved(repeat_start(problem.guess.start, 2 * states), change.reshape(-1, states))
    found = np.nan_to_num(windows.errors(np.tile(z, (2 * states, 1)), start))
    here = np.nan_to_num(errors)
    return np.stack([steady(here - found[2 * i], found[2 * i + 1] - here) for i in range(states)], -1)


def _step(fit: WindowFit, held: Sequence[int]) -> np.ndarray:
    free = np.setdiff1d(np.arange(len(fit.z)), np.asarray(held, int))
    step = np.zeros(len(fit.z))
    if len(free):
        pull = fit.slopes.sum(0) - fit.z
        step[free] = np.linalg.solve(fit.gram[np.ix_(free, free)], pull[free])
    return step * min(1.0, LARGEST_STEP / max(np.abs(step).max(initial=0.0), 1e-12))


def _within(fit: WindowFit, z: np.ndarray) -> np.ndarray:
    """Within the prior's digits, and where an effect's parameters may be."""
    psi = np.arange(len(z)) < fit.problem.num_psi
    return np.maximum(np.where(psi, np.clip(z, -FARTHEST, FARTHEST), z), fit.problem.floor)
