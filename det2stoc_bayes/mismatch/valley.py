"""Coordinates that follow a bent valley: where unknowns nearly trade, or a prior's bound bends one of them.

A Gaussian at the fit leaves such a valley a few widths from the fit; proposals that then adapt shrink to the stretch
that is still straight, and no diagnostic of their weights shows what they never visited. Here the floor is found by
Gauss-Newton across the valley at nodes along it (a predictor and a corrector), and draws are moved with the floor: a
shear, whose volume is known.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol, Self, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import BarycentricInterpolator, RBFInterpolator

from det2stoc_bayes.density import scale_of
from det2stoc_bayes.mismatch.coordinates import Coordinates

ALONG = 1e-3  # of a coordinate: finite difference of the base's own map
BENT = 1.0  # nats that one sd along a direction costs beyond the 0.5 of a Gaussian
NEGLIGIBLE = 6.0  # nats below the best node: a valley is followed no further
FIRST, SHORTEST = 0.4, 0.02  # sds between nodes
FEWEST, ORDER = 5, 4  # nodes of a valley, and those of which a polynomial predicts the next
GENTLE, FAR = 1.5, 6.0  # widths by which a predicted floor may be off: for longer steps, and for the node to serve
MOST_EVALUATIONS = 500  # that following may take, but for what the last nodes need
STEP = 0.05  # of a width: finite differences of residuals across the valley
ITERATIONS, CHORDS = 4, 3  # across, at each node: sensitivities, and steps with the same ones
SETTLED = 0.05  # nats that another step promises
SHORTER = (1.0, 0.3, 0.1)  # of a step that overshoots
ROUNDING = 1e-9  # of z: nearer to a wall is on it


@runtime_checkable
class Target(Protocol):
    """What is asked of a density, `Density`'s: -1/2 |projected(z)|^2 - 1/2 |z|^2 and a constant."""

    @property
    def center(self) -> Float[np.ndarray, " size"]:
        """z of the fit."""
        ...

    def projected(self, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "segments stacked points"]:
        """Whitened residuals."""
        ...

    def walled(
        self, z: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points size"], Bool[np.ndarray, " points"]]:
        """Points within the walls, and which had to be moved there."""
        ...

    def chunks(self, points: int) -> Iterator[slice]:
        """Points whose residuals fit in memory together."""
        ...


class Valley:
    """`base`, sheared: one coordinate goes along the valley, those across are counted from its floor in its widths."""

    def __init__(self, base: Coordinates, axes: Float[np.ndarray, "size free"], nodes: "Nodes"):
        self._base, self._axes = base, axes
        across = nodes.floor.shape[1]
        self._lower = np.tril_indices(across)
        self._diagonal = self._lower[0] == self._lower[1]
        shapes = nodes.root[:, *self._lower]
        shapes[:, self._diagonal] = np.log(shapes[:, self._diagonal])
        along = nodes.along[:, None]
        self._ends = along.min(), along.max()
        # Cubic splines, linear beyond the nodes; there the widths stay, whose logarithms would grow without end.
        self._floor, self._shapes = (RBFInterpolator(along, v, kernel="cubic", degree=1) for v in (nodes.floor, shapes))
        self.whole, self.evaluations = nodes.whole, 0

    @classmethod
    def about(cls, density: Target, base: Coordinates) -> Self | None:
        """The valley through a fit; None where every direction is straight, or no floor is found."""
        free, origin = base.size - base.spreads, _origin(density, base)
        if free < 2:
            return None
        jacobian = _jacobian(base, np.zeros(base.size))[:, base.spreads :]
        axes = np.zeros((base.size, free))
        axes[base.spreads :] = np.linalg.svd(jacobian, full_matrices=False)[2].T  # those that move z farthest first
        held = np.where(np.arange(base.size) < base.spreads, origin, 0.0)
        given = _Residuals(density, base, axes, held)
        along = _bent(given, origin @ axes)[:1]
        if not along:
            return None
        axes = axes[:, np.concatenate([along, np.delete(np.arange(free), along)])]
        ordered = _Residuals(density, base, axes, held)
        nodes = _follow(ordered, origin @ axes)
        if len(nodes.along) < FEWEST:
            return None
        valley = cls(base, axes, nodes)
        straightened = _Residuals(density, valley, np.eye(base.size)[:, base.spreads :], held)
        valley.whole &= not _bent(straightened, np.zeros(free))
        valley.evaluations = sum(r.evaluations for r in (given, ordered, straightened))
        return valley

    @property
    def size(self) -> int:
        """Of x and of z."""
        return self._base.size

    @property
    def spreads(self) -> int:
        """As the base's."""
        return self._base.spreads

    def __call__(
        self, x: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points size"], Float[np.ndarray, " points"]]:
        """z, and log |dz / dx|."""
        spreads, along, across = np.split(x, [self.spreads, self.spreads + 1], axis=1)
        shapes = self._shapes(np.clip(along, *self._ends))
        log_widths = shapes[:, self._diagonal]
        root = np.zeros((len(x), across.shape[1], across.shape[1]))
        root[:, *self._lower] = np.where(self._diagonal, np.exp(np.where(self._diagonal, shapes, 0.0)), shapes)
        moved = self._floor(along) + np.einsum("pij,pj->pi", root, across)
        inner = np.concatenate([along, moved], 1) @ self._axes.T
        inner[:, : self.spreads] = spreads
        z, volume = self._base(inner)
        return z, volume + log_widths.sum(1)


@dataclass(frozen=True, eq=False)
class Nodes:
    """Places along a valley: the floor across there, widths about there (lower triangular), energy, and whether it is
    one; `whole` if both ends are where nothing is believed any more."""

    along: Float[np.ndarray, " nodes"]
    floor: Float[np.ndarray, "nodes across"]
    root: Float[np.ndarray, "nodes across across"]
    energy: Float[np.ndarray, " nodes"]
    found: Bool[np.ndarray, " nodes"]
    whole: bool = False

    def kept(self, rows: Bool[np.ndarray, " nodes"]) -> "Nodes":
        """Some of them."""
        return Nodes(self.along[rows], self.floor[rows], self.root[rows], self.energy[rows], self.found[rows])

    def joined(self, others: "Nodes") -> "Nodes":
        """These and others."""
        return Nodes(
            np.concatenate([self.along, others.along]),
            np.concatenate([self.floor, others.floor]),
            np.concatenate([self.root, others.root]),
            np.concatenate([self.energy, others.energy]),
            np.concatenate([self.found, others.found]),
        )

    def predicted(self, along: Float[np.ndarray, " places"]) -> Float[np.ndarray, "places across"]:
        """The floor elsewhere, by a polynomial through the nearest nodes."""
        if len(self.along) == 1:
            return np.repeat(self.floor, len(along), 0)
        near = [np.argsort(np.abs(self.along - t))[:ORDER] for t in along]
        pairs = zip(along, near, strict=True)
        return np.stack([BarycentricInterpolator(self.along[n], self.floor[n], rng=0)(t) for t, n in pairs])

    def widths_from(self, floor: Float[np.ndarray, "nodes across"]) -> Float[np.ndarray, " nodes"]:
        """How far each floor is from another, in its widths."""
        off = np.linalg.solve(self.root, (self.floor - floor)[..., None])[..., 0]
        return np.linalg.norm(off, axis=1)


def _jacobian(base: Coordinates, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, "size size"]:
    """dz / dx."""
    step = ALONG * np.eye(base.size)
    return (base(x + step)[0] - base(x - step)[0]).T / (2 * ALONG)


def _origin(density: Target, base: Coordinates) -> Float[np.ndarray, " size"]:
    """x of the fit: the base's own centre is where the deepest point would be if the valley were straight."""
    x = np.zeros(base.size)
    for _ in range(3):  # the base is affine, or nearly so
        apart = density.center - base(x[None])[0][0]
        x = x + np.linalg.lstsq(_jacobian(base, x), apart, rcond=None)[0]
    return x


class _Residuals:
    """Half whose squared length is minus the log posterior, up to a constant; NaN beyond a wall. They are counted."""

    def __init__(
        self,
        density: Target,
        base: Coordinates,
        axes: Float[np.ndarray, "size free"],
        held: Float[np.ndarray, " size"],
    ):
        self._density, self._base, self._axes, self._held = density, base, axes, held
        self.evaluations = 0

    def __call__(self, x: Float[np.ndarray, "points free"]) -> Float[np.ndarray, "points values"]:
        self.evaluations += len(x)
        asked = self._base(x @ self._axes.T + self._held)[0]
        z = self._density.walled(asked)[0]
        beyond = np.abs(z - asked).max(1) > ROUNDING
        parts = [np.moveaxis(self._density.projected(z[rows]), -1, 0) for rows in self._density.chunks(len(z))]
        out = np.concatenate([np.concatenate(parts).reshape(len(z), -1), z], 1)
        out[beyond] = np.nan
        return out


def _energy(residuals: Float[np.ndarray, "points values"]) -> Float[np.ndarray, " points"]:
    """Minus the log posterior; infinite where it is none."""
    energy = 0.5 * np.square(residuals).sum(1)
    return np.where(np.isfinite(energy), energy, np.inf)


def _bent(residuals: _Residuals, origin: Float[np.ndarray, " size"]) -> list[int]:
    """Directions along which one sd either way, but for what is beyond a wall, costs more than a Gaussian's."""
    one = np.eye(len(origin))
    here, *costs = _energy(residuals(origin + np.concatenate([np.zeros((1, len(origin))), one, -one])))
    if not np.isfinite(here):
        return []
    sides = np.stack(np.split(np.array(costs), 2)) - here
    walled = ~np.isfinite(sides)
    cost = np.where(walled, 0.0, sides).sum(0) / np.maximum((~walled).sum(0), 1)
    return [int(i) for i in np.flatnonzero(cost > 0.5 + BENT)]


def _follow(residuals: _Residuals, origin: Float[np.ndarray, " size"]) -> Nodes:
    """Nodes along the first coordinate, both ways from `origin`, as far as a floor is found and believed."""
    nodes = _across(residuals, origin[:1], origin[None, 1:])
    if not nodes.found.all():
        return nodes.kept(nodes.found)
    ways, at = np.array([-1.0, 1.0]), np.zeros(2)
    step, over = np.full(2, FIRST), np.zeros(2, bool)
    while residuals.evaluations < MOST_EVALUATIONS and (live := np.flatnonzero((step > SHORTEST) & ~over)).size:
        along = origin[0] + (at + step)[live] * ways[live]
        guess = nodes.predicted(along)
        tried = _across(residuals, along, guess)
        off = tried.widths_from(guess)
        serves = tried.found & (off < FAR)
        nodes = nodes.joined(tried.kept(serves))
        at[live] += np.where(serves, step[live], 0.0)
        over[live] = serves & (tried.energy > nodes.energy.min() + NEGLIGIBLE)
        step[live] *= np.where(serves, np.where(off < GENTLE, 1.6, 0.8), 1.0 / 3.0)
    return replace(nodes, whole=bool(over.all()))


def _across(
    residuals: _Residuals, along: Float[np.ndarray, " nodes"], guess: Float[np.ndarray, "nodes across"]
) -> Nodes:
    """Gauss-Newton across the valley at each node; its sensitivities serve for a few steps."""
    count, size = guess.shape
    floor, root = guess.copy(), np.repeat(np.eye(size)[None], count, 0)

    def at(rows: np.ndarray, across: np.ndarray) -> np.ndarray:
        return residuals(np.concatenate([along[rows, None], across], 1))

    here = at(np.arange(count), floor)
    slope = np.zeros((count, size, here.shape[1]))
    found, lost = np.zeros(count, bool), ~np.isfinite(_energy(here))
    for _ in range(ITERATIONS):
        rows = np.flatnonzero(~found & ~lost)
        if not len(rows):
            break
        for row in rows:
            steps = STEP * root[row].T
            change = at(np.full(size, row), floor[row] + steps) - here[row]
            barred = ~np.isfinite(change).all(1)
            if barred.any():  # by a wall, or because it diverges
                change[barred] = here[row] - at(np.full(barred.sum(), row), floor[row] - steps[barred])
            lost[row] = not np.isfinite(change).all()
            if lost[row]:
                continue
            slope[row] = np.linalg.solve(steps, change)
            try:
                root[row] = scale_of(slope[row] @ slope[row].T)
            except np.linalg.LinAlgError:  # beyond double precision
                lost[row] = True
        for chord in range(CHORDS):
            rows = rows[~lost[rows]]
            pull = np.einsum("nji,njv,nv->ni", root[rows], slope[rows], here[rows])
            found[rows] = 0.5 * np.square(pull).sum(1) < SETTLED
            rows, pull = rows[~found[rows]], pull[~found[rows]]
            move, left = -np.einsum("nij,nj->ni", root[rows], pull), np.arange(len(rows))
            for shorter in SHORTER:
                if not len(left):
                    break
                tried = floor[rows[left]] + shorter * move[left]
                r = at(rows[left], tried)
                better = _energy(r) < _energy(here[rows[left]])
                floor[rows[left[better]]], here[rows[left[better]]] = tried[better], r[better]
                left = left[~better]
            if chord == 0:
                lost[rows[left]] = True
            rows = np.delete(rows, left)  # later ones want new sensitivities
    return Nodes(along, floor, root, _energy(here), found)
