"""Distributions that a scene's psi are drawn from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats


@dataclass(frozen=True)
class Normals:
    """Independent normals, truncated where bounds are given."""

    loc: tuple[float, ...]
    scale: tuple[float, ...]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "count psi"]:
        """`count` parameters."""
        loc, scale = np.array(self.loc), np.array(self.scale)
        low = np.full(len(loc), -np.inf) if not self.low else np.array(self.low)
        high = np.full(len(loc), np.inf) if not self.high else np.array(self.high)
        a, b = (low - loc) / scale, (high - loc) / scale
        return np.asarray(stats.truncnorm.rvs(a, b, loc, scale, size=(count, len(loc)), random_state=random))


@dataclass(frozen=True)
class Uniforms:
    """Independent uniform distributions."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "count psi"]:
        """`count` parameters."""
        return random.uniform(self.low, self.high, (count, len(self.low)))


def normal_draws(
    loc: Float[np.ndarray, " psi"],
    scale: Float[np.ndarray, " psi"],
    random: np.random.Generator,
    count: int,
    least: tuple[float, ...],
) -> Float[np.ndarray, "count psi"]:
    """psi of independent normals, moved to what each is at least."""
    return np.maximum(loc + scale * random.standard_normal((count, len(loc))), least)
