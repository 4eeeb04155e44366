"""What simulations tell of a psi as a density of what is seen: a smooth mean, and the scatter that is left about it."""

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

DEGREE = 8  # of the polynomial, in all psi together
LEAST_MOVED = 0.05  # error sds: components that psi moves by less say nothing of it


@dataclass(frozen=True, eq=False)
class Response:
    """x ~ Normal(a polynomial of psi, what simulations scatter about it and noise), in white components."""

    low: Float[np.ndarray, " psi"]
    high: Float[np.ndarray, " psi"]
    whitener: Float[np.ndarray, "features components"]
    weights: Float[np.ndarray, "terms components"]
    log_volume: float

    @classmethod
    def of(
        cls,
        psi: Float[np.ndarray, "sims psi"],
        seen: Float[np.ndarray, "sims features"],
        noise: Float[np.ndarray, " features"],
        box: tuple[Float[np.ndarray, " psi"], Float[np.ndarray, " psi"]],
        degree: int = DEGREE,
    ) -> "Response":
        """From simulations without noise; `box`: the least and the largest psi."""
        columns = _terms(psi, *box, degree)
        weights = np.linalg.lstsq(columns, seen / noise)[0]
        mean = columns @ weights
        left = seen / noise - mean
        count, used = columns.shape
        # What is predicted anew errs by the polynomial's own uncertainty as well.
        scatter = left.T @ left / (count - used) * (1 + used / count) + np.eye(len(noise))
        root = np.linalg.inv(np.linalg.cholesky(scatter)).T
        spread, axes = np.linalg.eigh(np.cov((mean @ root).T))
        whitener = root @ axes[:, np.sqrt(np.maximum(spread, 0)) > LEAST_MOVED]
        volume = 0.5 * np.linalg.slogdet(whitener.T @ whitener)[1] - 0.5 * whitener.shape[1] * np.log(2 * np.pi)
        return cls(*box, whitener / noise[:, None], weights @ whitener, float(volume))

    def components(self, seen: Float[np.ndarray, "rows features"]) -> Float[np.ndarray, "rows components"]:
        """What is seen, in components of unit error."""
        return seen @ self.whitener

    def predicted(self, psi: Float[np.ndarray, "rows psi"]) -> Float[np.ndarray, "rows components"]:
        """Their means."""
        return _terms(psi, self.low, self.high, self.degree) @ self.weights

    @property
    def degree(self) -> int:
        """Of the polynomial."""
        size = len(self.low)
        return next(d for d in range(100) if len(_exponents(size, d)) == len(self.weights))

    def log_density(
        self, psi: Float[np.ndarray, "rows psi"], components: Float[np.ndarray, "rows components"]
    ) -> Float[np.ndarray, " rows"]:
        """log density of components under each psi, in the units of what is seen over its noise."""
        return self.log_volume - 0.5 * ((components - self.predicted(psi)) ** 2).sum(1)


def _terms(
    psi: Float[np.ndarray, "rows psi"], low: Float[np.ndarray, " psi"], high: Float[np.ndarray, " psi"], degree: int
) -> Float[np.ndarray, "rows terms"]:
    """Products of Chebyshev polynomials of psi's place in the box."""
    place = 2 * (psi - low) / (high - low) - 1
    each = [chebyshev.chebvander(column, degree) for column in place.T]
    out = np.ones((len(psi), 1))
    powers = np.array(_exponents(psi.shape[1], degree))
    for values, power in zip(each, powers.T, strict=True):
        out = out * values[:, power]
    return out


@cache
def _exponents(size: int, degree: int) -> tuple[tuple[int, ...], ...]:
    return tuple(e for e in product(range(degree + 1), repeat=size) if sum(e) <= degree)
