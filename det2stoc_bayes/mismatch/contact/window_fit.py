"""The most likely unknowns of a hypothesis on windows, by Gauss-Newton steps with bounded influence.

A few windows make or break a contact, where a derivative is a thousand times the others': their say is bounded, and
each step is kept only if the likelihood itself, which needs no derivative, says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.scales import Scales, scales_of, scatter
from det2stoc_bayes.mismatch.contact.windows import Windows

STEP = 0.15  # prior sds to either side: a finite difference over which contact is smooth enough
AGREE = 0.3  # relative difference of the slopes to either side beyond which a sensitivity is chaos
SEEN = 1e-5  # of the largest sensitivity: what is less is none
FRACTIONS = (3.0, 1.0, 0.4, 0.1)  # of a step
LARGEST_STEP = 2.0  # prior sds at once
ITERATIONS = 8
SETTLED = 0.02  # nats
INFLUENCE = 3.0  # times the upper quartile of sensitivities: beyond it they are weighed down
FARTHEST = 5.0  # prior sds of psi from its median


@dataclass(frozen=True, eq=False)
class WindowFit:
    """A hypothesis at its most likely unknowns; `columns` are sensitivities of the prediction in noise sds."""

    windows: Windows
    z: Float[np.ndarray, " size"]
    errors: Float[np.ndarray, "windows horizons columns"]
    scales: Scales
    columns: Float[np.ndarray, "windows horizons columns size"]

    @property
    def problem(self):
        """The hypothesis."""
        return self.windows.problem

    @cached_property
    def losses(self) -> Float[np.ndarray, " windows"]:
        """-log likelihood of each window."""
        return self.scales.losses(self.errors)

    @property
    def loss(self) -> float:
        """-log posterior, up to a constant."""
        return float(self.losses.sum() + 0.5 * self.z @ self.z)

    @cached_property
    def weights(self) -> Float[np.ndarray, "windows horizons columns"]:
        """Of squared errors, the influence of violent windows bounded."""
        return self.scales.weights(self.errors) * bounded(self.columns)

    @cached_property
    def gram(self) -> Float[np.ndarray, "size size"]:
        """Curvature of the log posterior."""
        return np.einsum("whc,whck,whcl->kl", self.weights, self.columns, self.columns) + np.eye(len(self.z))

    @cached_property
    def slopes(self) -> Float[np.ndarray, "windows size"]:
        """Each window's pull on the unknowns."""
        return np.einsum("whc,whck,whc->wk", self.weights, self.columns, np.nan_to_num(self.errors))

    @cached_property
    def covariance(self) -> Float[np.ndarray, "size size"]:
        """Of the unknowns: the sandwich of curvature and scatter over windows, the prior being one more observation."""
        inverse = np.linalg.inv(self.gram)
        return inverse @ (scatter(self.slopes, self.windows.recording) + np.eye(len(self.z))) @ inverse


def bounded(columns: Float[np.ndarray, "windows horizons columns size"]) -> np.ndarray:
    """Weights at most 1 that hold each window's sensitivity within a few times what most windows have."""
    weight = np.ones(columns.shape[:3])
    for k in range(columns.shape[3]):
        x = np.abs(columns[..., k])
        some = np.where(x > SEEN * x.max(0, keepdims=True), x, np.nan)
        limit = np.full((1, *x.shape[1:]), np.inf)
        there = np.isfinite(some).any(0)
        limit[0, there] = INFLUENCE * np.nanpercentile(some[:, there], 75, axis=0)
        weight = np.minimum(weight, np.where(x > limit, limit / np.maximum(x, 1e-300), 1.0))
    return weight


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
) -> WindowFit:
    """The most likely unknowns from `z`, or from the best of it and `others`; those `held` stay."""
    tried = np.stack([np.zeros(windows.problem.size) if z is None else np.array(z, float), *others])
    best = windows.errors(tried)
    i = int(np.argmin([_height(e, p) for e, p in zip(best, tried, strict=True)]))
    fit = _linearized(windows, tried[i], best[i])
    for _ in range(iterations):
        step = _step(fit, held)
        moved = np.stack([_within(fit, fit.z + f * step) for f in FRACTIONS])
        errors = windows.errors(moved)
        heights = [_height(e, p) for e, p in zip(errors, moved, strict=True)]
        i = int(np.argmin(heights))
        gain = fit.loss - heights[i]
        if not gain > 0:
            break
        fit = _linearized(windows, moved[i], errors[i])
        if gain < SETTLED:
            break
    return fit


def at(windows: Windows, z: Float[np.ndarray, " size"], scales: Scales | None = None) -> WindowFit:
    """The hypothesis at given unknowns, under scales that may be given."""
    fit = _linearized(windows, np.asarray(z, float), windows.errors(np.asarray(z, float)[None])[0])
    return fit if scales is None else replace(fit, scales=scales)


def _height(errors: np.ndarray, z: np.ndarray) -> float:
    return float(scales_of(errors).losses(errors).sum() + 0.5 * z @ z)


def _linearized(windows: Windows, z: np.ndarray, errors: np.ndarray) -> WindowFit:
    """Sensitivities by finite differences; values of different recordings are moved together."""
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
    return WindowFit(windows, z, errors, scales_of(errors), columns)


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
