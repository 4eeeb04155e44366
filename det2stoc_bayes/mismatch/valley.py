"""Coordinates that follow a bent valley: where unknowns nearly trade, or a prior's bound bends one of them.

A Gaussian at the fit leaves such a valley a few widths from the fit; proposals that then adapt shrink to the stretch
that is still straight, and no diagnostic of their weights shows what they never visited. Here the floor is found by
Gauss-Newton across the valley at nodes along it (a predictor and a corrector), and draws are moved with the floor: a
shear, whose volume is known.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, Self, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import BarycentricInterpolator, RBFInterpolator

from det2stoc_bayes.density import scale_of
from det2stoc_bayes.mismatch.coordinates import Coordinates

ALONG = 1e-3  # of a coordinate: finite difference of the base's own map
BENT = 1.0  # nats that one sd along a direction costs beyond the 0.5 of a Gaussian
MOST = 2  # directions that are followed, the softest
REACH = 3.5  # sds along
LONGEST, SHORTEST = 0.75, 0.02  # sds between nodes
ORDER = 4  # nodes of which a polynomial predicts the next
NEAR, FAR = 1.5, 6.0  # widths by which a predicted floor may be off: for longer steps, and for the node to serve
NEGLIGIBLE = 12.0  # nats below the fit: a valley is followed no further
MOST_NODES = 24  # of a ray
STEP = 0.05  # of a width: finite differences of residuals across the valley
ITERATIONS, CHORDS = 4, 3  # across, at each node: sensitivities, and steps with the same ones
SETTLED = 0.05  # nats that another step promises
SHORTER = (1.0, 0.3, 0.1)  # of a step that overshoots

Residuals = Callable[[Float[np.ndarray, "points size"]], Float[np.ndarray, "points values"]]


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
    """`base`, sheared: coordinates along are the base's, those across are counted from the floor in its widths."""

    def __init__(self, base: Coordinates, axes: Float[np.ndarray, "size free"], nodes: "Nodes"):
        self._base, self._axes, self._count = base, axes, nodes.along.shape[1]
        across = nodes.floor.shape[1]
        self._lower = np.tril_indices(across)
        self._diagonal = self._lower[0] == self._lower[1]
        shapes = nodes.root[:, *self._lower]
        shapes[:, self._diagonal] = np.log(shapes[:, self._diagonal])
        # Where there is one direction this is a cubic spline, linear beyond the nodes.
        self._told = RBFInterpolator(nodes.along, np.concatenate([nodes.floor, shapes], 1), kernel="cubic", degree=1)

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
        along = _bent(_in_axes(density, base, axes, held), origin @ axes)[: min(MOST, free - 1)]
        if not len(along):
            return None
        axes = axes[:, np.concatenate([along, np.delete(np.arange(free), along)])]
        nodes = follow(_in_axes(density, base, axes, held), origin @ axes, len(along))
        return cls(base, axes, nodes) if len(nodes.along) > 2 * len(along) else None

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
        ends = np.cumsum([self.spreads, self._count])
        spreads, along, across = np.split(x, ends, axis=1)
        size = across.shape[1]
        floor, shapes = np.split(self._told(along), [size], axis=1)
        log_widths = shapes[:, self._diagonal]
        root = np.zeros((len(x), size, size))
        root[:, *self._lower] = np.where(self._diagonal, np.exp(np.where(self._diagonal, shapes, 0.0)), shapes)
        moved = floor + np.einsum("pij,pj->pi", root, across)
        inner = np.concatenate([along, moved], 1) @ self._axes.T
        inner[:, : self.spreads] = spreads
        z, volume = self._base(inner)
        return z, volume + log_widths.sum(1)


@dataclass(frozen=True, eq=False)
class Nodes:
    """Places along a valley: the floor across there, its widths (lower triangular), energy, and whether it is one."""

    along: Float[np.ndarray, "nodes along"]
    floor: Float[np.ndarray, "nodes across"]
    root: Float[np.ndarray, "nodes across across"]
    energy: Float[np.ndarray, " nodes"]
    found: Bool[np.ndarray, " nodes"]

    def kept(self, rows: Bool[np.ndarray, " nodes"]) -> "Nodes":
        """Some of them."""
        return Nodes(self.along[rows], self.floor[rows], self.root[rows], self.energy[rows], self.found[rows])

    def joined(self, others: "Nodes") -> "Nodes":
        """These and others."""
        pairs = ((getattr(self, n), getattr(others, n)) for n in ("along", "floor", "root", "energy", "found"))
        return Nodes(*(np.concatenate(pair) for pair in pairs))

    def predicted(
        self, begin: Float[np.ndarray, " along"], along: Float[np.ndarray, "rays along"]
    ) -> Float[np.ndarray, "rays across"]:
        """The floor further on, on each ray from `begin`, by a polynomial through the nearest nodes of its line."""
        out = np.empty((len(along), self.floor.shape[1]))
        for i, way in enumerate(along - begin):
            t = (self.along - begin) @ way / (way @ way)  # of the way there; behind `begin` negative
            mine = np.flatnonzero(np.abs(self.along - begin - t[:, None] * way).max(1) < 1e-9)
            near = mine[np.argsort(np.abs(t[mine] - 1.0))][:ORDER]
            out[i] = BarycentricInterpolator(t[near], self.floor[near])(1.0) if len(near) > 1 else self.floor[near[0]]
        return out

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


def _in_axes(
    density: Target, base: Coordinates, axes: Float[np.ndarray, "size free"], held: Float[np.ndarray, " size"]
) -> Residuals:
    """Half whose squared length is minus the log posterior, up to a constant; NaN beyond a wall."""

    def residuals(x: np.ndarray) -> np.ndarray:
        z, beyond = density.walled(base(x @ axes.T + held)[0])
        parts = [np.moveaxis(density.projected(z[rows]), -1, 0) for rows in density.chunks(len(z))]
        out = np.concatenate([np.concatenate(parts).reshape(len(z), -1), z], 1)
        out[beyond] = np.nan
        return out

    return residuals


def _energy(residuals: Float[np.ndarray, "points values"]) -> Float[np.ndarray, " points"]:
    """Minus the log posterior; infinite where it is none."""
    energy = 0.5 * np.square(residuals).sum(1)
    return np.where(np.isfinite(energy), energy, np.inf)


def _bent(residuals: Residuals, origin: Float[np.ndarray, " size"]) -> list[int]:
    """Directions along which one sd either way costs, on average, more than a Gaussian's."""
    one = np.eye(len(origin))
    here, *costs = _energy(residuals(origin + np.concatenate([np.zeros((1, len(origin))), one, -one])))
    if not np.isfinite(here):
        return []
    cost = np.mean(np.split(np.array(costs), 2), 0) - here
    return [int(i) for i in np.flatnonzero(cost > 0.5 + BENT)]


def follow(residuals: Residuals, origin: Float[np.ndarray, " size"], count: int) -> Nodes:
    """Nodes along the first `count` coordinates; a ray ends where no floor is found, or none is believed."""
    nodes = _across(residuals, origin[None, :count], origin[None, count:])
    if not nodes.found.all():
        return nodes.kept(nodes.found)
    angle = np.pi / 4 * np.arange(8)
    rays = np.stack([np.cos(angle), np.sin(angle)], 1) if count == 2 else np.array([[-1.0], [1.0]])
    at, step = np.zeros(len(rays)), np.full(len(rays), LONGEST / 2)
    for _ in range(MOST_NODES):
        live = np.flatnonzero((step > SHORTEST) & (at < REACH))
        if not len(live):
            break
        along = origin[:count] + (at + step)[live, None] * rays[live]
        guess = nodes.predicted(origin[:count], along)
        tried = _across(residuals, along, guess)
        off = tried.widths_from(guess)
        serves = tried.found & (off < FAR)
        nodes = nodes.joined(tried.kept(serves))
        at[live] += np.where(serves, step[live], 0.0)
        longer = np.minimum(step[live] * np.where(off < NEAR, 1.6, 0.8), LONGEST)
        over = serves & (tried.energy > nodes.energy[0] + NEGLIGIBLE)
        step[live] = np.where(over, 0.0, np.where(serves, longer, step[live] / 3))
    return nodes


def _across(
    residuals: Residuals, along: Float[np.ndarray, "nodes along"], guess: Float[np.ndarray, "nodes across"]
) -> Nodes:
    """Gauss-Newton across the valley at each node; its sensitivities serve for a few steps."""
    count, size = guess.shape
    floor, root = guess.copy(), np.repeat(np.eye(size)[None], count, 0)
    found, lost = np.zeros(count, bool), np.zeros(count, bool)

    def at(rows: np.ndarray, across: np.ndarray) -> np.ndarray:
        return residuals(np.concatenate([along[rows], across], 1))

    here = at(np.arange(count), floor)
    slope = np.zeros((count, size, here.shape[1]))
    lost |= ~np.isfinite(_energy(here))
    for _ in range(ITERATIONS):
        rows = np.flatnonzero(~found & ~lost)
        if not len(rows):
            break
        steps = STEP * np.swapaxes(root[rows], 1, 2)
        beside = at(np.repeat(rows, size), (floor[rows, None] + steps).reshape(-1, size)).reshape(len(rows), size, -1)
        # A neighbour that diverges tells nothing.
        slope[rows] = np.linalg.solve(steps, np.nan_to_num(beside - here[rows, None]))
        for row in rows:
            precision = slope[row] @ slope[row].T
            lost[row] = not (np.diag(precision) > 0.0).all()
            root[row] = root[row] if lost[row] else scale_of(precision)
        for _ in range(CHORDS):
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
            lost[rows[left]] = True
    return Nodes(along, floor, root, _energy(here), found)
