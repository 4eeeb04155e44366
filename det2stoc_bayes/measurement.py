"""How a recorded value scatters about a prediction: normally, or with heavy tails that outliers cannot bend.

A Student-t density with nu degrees of freedom is proportional to exp(-rho(e)^2 / 2) with
    rho(e) = sign(e) sqrt((nu + 1) log(1 + e^2 / nu)),
so that least squares in rho(e) instead of e, the error in noise sds, maximizes it (iteratively reweighted least
squares, the weight being rho'(e)^2); with infinite nu rho(e) = e.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import digamma, gammaln

Array = Any
TINY = 1e-8  # of e^2 / nu: below it the series


@dataclass(frozen=True)
class Measurement:
    """Density of an error in noise sds; `degrees_of_freedom` of Student's t, None of the normal density."""

    degrees_of_freedom: float | None = None

    @property
    def log_peak(self) -> float:
        """log density at 0."""
        nu = self.degrees_of_freedom
        if nu is None:
            return -0.5 * float(np.log(2 * np.pi))
        return float(gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(nu * np.pi))

    @property
    def mean_square(self) -> float:
        """Expected rho^2 under this density itself: 1 if normal."""
        nu = self.degrees_of_freedom
        return 1.0 if nu is None else float((nu + 1) * (digamma((nu + 1) / 2) - digamma(nu / 2)))

    def bend(self, error: Array, xp: Any = np) -> Array:
        """rho(e), for arrays of either library."""
        nu = self.degrees_of_freedom
        if nu is None:
            return error
        x = error**2 / nu
        small = x < TINY
        return error * xp.sqrt((nu + 1) / nu * xp.where(small, 1 - x / 2, xp.log1p(x) / xp.where(small, 1.0, x)))

    def unbent(self, bent: Array) -> Array:
        """e where rho(e) is given."""
        nu = self.degrees_of_freedom
        return bent if nu is None else np.sign(bent) * np.sqrt(nu * np.expm1(bent**2 / (nu + 1)))

    def slope(self, error: Array) -> Array:
        """rho'(e)."""
        nu = self.degrees_of_freedom
        if nu is None:
            return np.ones_like(error)
        x = error**2 / nu
        small = x < TINY
        ratio = np.where(small, 1 - x / 2, np.log1p(x) / np.where(small, 1.0, x))
        return np.sqrt((nu + 1) / nu / ratio) / (1 + x)
