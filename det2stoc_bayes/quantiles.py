"""Quantile functions at Phi(z): the maps that turn a standard normal number into a draw of a prior.

Each takes the prior's arguments, z and the functions of one array library. A tail is always measured from
its own end, since 1 - p loses every digit beyond 8 standard deviations.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

Array = Any  # numpy's or jax's; jax is not imported here
Arguments = dict[str, Any]  # floats, or arrays that broadcast with z


class Library(NamedTuple):
    """An array library and its special functions."""

    xp: ModuleType
    special: Any


Quantile = Callable[[Arguments, Array, Library], Array]


def library(xp: ModuleType) -> Library:
    """numpy with scipy.special, or jax.numpy with jax.scipy.special."""
    if xp is np:
        return Library(np, special)
    from jax.scipy import special as jax_special

    return Library(xp, jax_special)


def log_ndtr(z: Array, lib: Library) -> Array:
    """log Phi(z), of which jax's own loses digits for z from 2 to 8."""
    negative = z < 0
    above = lib.xp.log1p(-lib.special.ndtr(lib.xp.where(negative, 0.0, -z)))
    return lib.xp.where(negative, lib.special.log_ndtr(lib.xp.where(negative, z, 0.0)), above)


def normal(a: Arguments, z: Array, lib: Library) -> Array:
    """Straight line."""
    return a["loc"] + a["scale"] * z


def truncated_normal(a: Arguments, z: Array, lib: Library) -> Array:
    """From the lower tail where the draw lies below loc, from the upper tail where it lies above."""
    low, high = a.get("low", -math.inf), a.get("high", math.inf)
    below, above, mass = tail_masses((low - a["loc"]) / a["scale"], (high - a["loc"]) / a["scale"], lib)
    p = below + lib.special.ndtr(z) * mass
    lower = p <= 0.5
    tail = lib.xp.where(lower, p, above + lib.special.ndtr(-z) * mass)
    # Never 0, where ndtri and its derivative are infinite, not even in single precision.
    distance = lib.special.ndtri(lib.xp.maximum(tail, lib.xp.finfo(tail.dtype).tiny))
    return lib.xp.clip(a["loc"] + a["scale"] * lib.xp.where(lower, distance, -distance), low, high)


def tail_masses(low: Array, high: Array, lib: Library) -> tuple[Array, Array, Array]:
    """What a standard normal has below low, above high and between."""
    ndtr = lib.special.ndtr
    low, high = lib.xp.asarray(low), lib.xp.asarray(high)
    between = lib.xp.where(low > 0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))
    return ndtr(low), ndtr(-high), between


def half_normal(a: Arguments, z: Array, lib: Library) -> Array:
    """By erfinv near 0, so that small draws keep their digits."""
    low = z < 0
    near = math.sqrt(2) * lib.special.erfinv(lib.special.ndtr(lib.xp.where(low, z, -1.0)))
    far = -lib.special.ndtri(lib.special.ndtr(-lib.xp.where(low, 1.0, z)) / 2)
    return a["scale"] * lib.xp.where(low, near, far)


def uniform(a: Arguments, z: Array, lib: Library) -> Array:
    """Measured from the nearer end."""
    width = a["high"] - a["low"]
    from_low, from_high = a["low"] + width * lib.special.ndtr(z), a["high"] - width * lib.special.ndtr(-z)
    return lib.xp.where(z < 0, from_low, from_high)


def log_normal(a: Arguments, z: Array, lib: Library) -> Array:
    """The exponential of a normal."""
    return lib.xp.exp(normal(a, z, lib))


def log_uniform(a: Arguments, z: Array, lib: Library) -> Array:
    """The exponential of a uniform; exp(log(high)) may round past high."""
    ends = {"low": math.log(a["low"]), "high": math.log(a["high"])}
    return lib.xp.clip(lib.xp.exp(uniform(ends, z, lib)), a["low"], a["high"])


def exponential(a: Arguments, z: Array, lib: Library) -> Array:
    """-log of the upper tail."""
    return -log_ndtr(-z, lib) / a["rate"]


def laplace(a: Arguments, z: Array, lib: Library) -> Array:
    """Log of twice the nearer tail on either side."""
    below = math.log(2) + lib.special.log_ndtr(lib.xp.where(z < 0, z, 0.0))
    above = math.log(2) + lib.special.log_ndtr(-lib.xp.where(z < 0, 0.0, z))
    return a["loc"] + a["scale"] * lib.xp.where(z < 0, below, -above)


def cauchy(a: Arguments, z: Array, lib: Library) -> Array:
    """Cotangent of the nearer tail."""
    distance = _cotangent(math.pi, lib.xp.where(z < 0, z, -z), lib)
    return a["loc"] + a["scale"] * lib.xp.where(z < 0, -distance, distance)


def half_cauchy(a: Arguments, z: Array, lib: Library) -> Array:
    """Tangent of the lower tail or cotangent of the upper."""
    nearer = lib.xp.where(z < 0, z, -z)
    tangent = lib.xp.tan(math.pi / 2 * lib.special.ndtr(nearer))
    return a["scale"] * lib.xp.where(z < 0, tangent, _cotangent(math.pi / 2, nearer, lib))


def _cotangent(angle: float, z: Array, lib: Library) -> Array:
    """cot(angle Phi(z)), from the tail's logarithm where a plain 1 / tan would overflow in its derivative."""
    u = angle * lib.special.ndtr(z)
    small = u < 1e-2
    series = lib.xp.exp(-math.log(angle) - log_ndtr(z, lib) - u**2 / 3 - 7 * u**4 / 90)
    return lib.xp.where(small, series, lib.xp.tan(math.pi / 2 - lib.xp.where(small, 1.0, u)))


def logistic(a: Arguments, z: Array, lib: Library) -> Array:
    """Log odds."""
    return a["loc"] + a["scale"] * (log_ndtr(z, lib) - log_ndtr(-z, lib))


def gumbel(a: Arguments, z: Array, lib: Library) -> Array:
    """-log(-log p)."""
    return a["loc"] - a["scale"] * lib.xp.log(-log_ndtr(z, lib))


def gamma(a: Arguments, z: Array, lib: Library) -> Array:
    """By table of the logarithm."""
    return lib.xp.exp(interpolate(gamma_table(a["concentration"]), z, lib.xp)) / a["rate"]


def inverse_gamma(a: Arguments, z: Array, lib: Library) -> Array:
    """The reciprocal of a gamma, whose upper tail is its lower."""
    return a["rate"] * lib.xp.exp(-interpolate(gamma_table(a["concentration"]), -z, lib.xp))


def beta(a: Arguments, z: Array, lib: Library) -> Array:
    """By table of the log odds."""
    return lib.special.expit(interpolate(beta_table(a["concentration1"], a["concentration0"]), z, lib.xp))


def student_t(a: Arguments, z: Array, lib: Library) -> Array:
    """By table of asinh, which is straight in the middle and logarithmic in the tails."""
    return a["loc"] + a["scale"] * lib.xp.sinh(interpolate(student_table(a["df"]), z, lib.xp))


# Tables, for the families without a quantile function in jax.

KNOTS_PER_UNIT = 128  # cubic pieces with exact slopes: the error is about (1/128)^4 / 384 of the fourth derivative
REACH = 30.0


@dataclass(frozen=True, eq=False)
class Table:
    """Cubic pieces over evenly spaced knots, continued by straight lines."""

    start: float
    step: float
    coefficients: Float[np.ndarray, "4 pieces"]
    first_slope: float
    last_slope: float


def interpolate(table: Table, z: Array, xp: ModuleType) -> Array:
    """The table at z, in either library by the same arithmetic."""
    pieces = table.coefficients.shape[1]
    end = table.start + table.step * pieces
    inside = xp.clip(z, table.start, end)
    piece = xp.clip(xp.floor((inside - table.start) / table.step).astype(int), 0, pieces - 1)
    c3, c2, c1, c0 = xp.asarray(table.coefficients)[:, piece]
    t = inside - (table.start + table.step * piece)
    beyond = table.first_slope * xp.minimum(z - table.start, 0.0) + table.last_slope * xp.maximum(z - end, 0.0)
    return ((c3 * t + c2) * t + c1) * t + c0 + beyond


def _tabulate(values: Callable[[Array], Array], slopes: Callable[[Array, Array], Array]) -> Table:
    """A monotone table of y(z) where y is finite and still rises, from -REACH to REACH at most."""
    z = np.arange(-REACH * KNOTS_PER_UNIT, REACH * KNOTS_PER_UNIT + 1) / KNOTS_PER_UNIT
    with np.errstate(all="ignore"):
        y = values(z)
        rate = slopes(z, y)
        good = np.isfinite(y) & np.isfinite(rate) & (rate > 0) & np.r_[True, np.diff(y) > 0]
    middle = len(z) // 2
    first = middle - int(np.argmin(np.r_[good[middle::-1], False])) + 1
    last = middle + int(np.argmin(np.r_[good[middle:], False])) - 1
    z, y, rate = z[first : last + 1], y[first : last + 1], rate[first : last + 1]
    step, secant = 1 / KNOTS_PER_UNIT, np.diff(y) * KNOTS_PER_UNIT
    # Fritsch and Carlson: slopes up to three secants keep each cubic rising, whatever rounding did to y.
    rate = np.minimum(rate, 3 * np.minimum(np.r_[secant[0], secant], np.r_[secant, secant[-1]]))
    left, right = rate[:-1], rate[1:]
    cubic, square = (left + right - 2 * secant) / step**2, (3 * secant - 2 * left - right) / step
    return Table(float(z[0]), step, np.stack([cubic, square, left, y[:-1]]), float(rate[0]), float(rate[-1]))


def _log_phi(z: Array) -> Array:
    return -0.5 * z**2 - 0.5 * math.log(2 * math.pi)


@lru_cache(maxsize=256)
def gamma_table(concentration: float) -> Table:
    """log of the unit-rate gamma's quantile."""
    from scipy import stats

    dist: Any = stats.gamma(concentration)
    return _tabulate(
        lambda z: np.log(np.where(z < 0, dist.ppf(special.ndtr(z)), dist.isf(special.ndtr(-z)))),
        lambda z, y: np.exp(_log_phi(z) - dist.logpdf(np.exp(y)) - y),
    )


@lru_cache(maxsize=256)
def beta_table(concentration1: float, concentration0: float) -> Table:
    """Log odds of the quantile; the upper half by the mirrored beta, where small numbers keep digits."""
    from scipy import stats

    dist, mirror = stats.beta(concentration1, concentration0), stats.beta(concentration0, concentration1)

    def log_odds(z: Array) -> Array:
        small = np.where(z < 0, dist.ppf(special.ndtr(z)), mirror.ppf(special.ndtr(-z)))
        return np.where(z < 0, 1, -1) * (np.log(small) - np.log1p(-small))

    def slopes(z: Array, y: Array) -> Array:
        log_x, log_rest = special.log_expit(y), special.log_expit(-y)
        log_pdf = (concentration1 - 1) * log_x + (concentration0 - 1) * log_rest
        log_pdf -= special.betaln(concentration1, concentration0)
        return np.exp(_log_phi(z) - log_pdf - log_x - log_rest)

    return _tabulate(log_odds, slopes)


@lru_cache(maxsize=256)
def student_table(df: float) -> Table:
    """asinh of the quantile."""
    from scipy import stats

    dist: Any = stats.t(df)
    return _tabulate(
        lambda z: -np.sign(z) * np.arcsinh(dist.ppf(special.ndtr(-np.abs(z)))),
        lambda z, y: np.exp(_log_phi(z) - dist.logpdf(np.sinh(y)) - np.logaddexp(y, -y) + math.log(2)),
    )
