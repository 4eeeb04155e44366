"""What the experiments on a scene need to know of it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.inference._amortized import Population
from det2stoc_bayes.models._population import Normals, Uniforms, normal_draws
from det2stoc_bayes.models._runs import Runs

Report = Callable[[int, int], None]  # done, total


class Scene(ABC):
    """A box with a hidden block, simulated under psi; `com` among psi is the block's x."""

    title: str
    model: Path
    names: tuple[str, ...]  # of psi
    units: tuple[str, ...]
    state: tuple[str, ...]
    shown: tuple[int, ...]  # numbers of the state whose densities are drawn
    blocks: Mapping[str, slice] = {}  # of the state, that are scored apart
    place: int  # where the box's place begins in the state
    matrix: int  # and where its rotation matrix does
    box: tuple[float, float, float]  # half-sizes [m]
    block: tuple[float, float, float]
    depth: float  # of the block's centre below the box's [m]
    num_steps: int
    reality: Normals
    prior: Normals | Uniforms
    least: tuple[float, ...]  # psi
    one_start: bool  # whether all episodes begin alike, so that only psi tells them apart
    real_episodes: tuple[int, ...]  # that each iteration has
    source: Mapping[str, tuple[float, float]]  # log likelihoods with a single z, and their sds
    oracles: Mapping[str, str]  # where an oracle's psi comes from

    @abstractmethod
    def simulate(self, psi: Float[np.ndarray, "episodes psi"], random: np.random.Generator, progress: Report) -> Runs:
        """Episodes."""

    @abstractmethod
    def change(
        self, runs: Runs, psi: Float[np.ndarray, "rows psi"], rows: Any = slice(None)
    ) -> Float[np.ndarray, "rows s"]:
        """How each transition's state would change under psi, from the simulator's own state and without new noise."""

    @abstractmethod
    def swept(self, psi: Float[np.ndarray, "episodes psi"]) -> Float[np.ndarray, "episodes samples 3"]:
        """The box's place in episodes that differ in psi alone."""

    def noise_variance(self, state: Float[np.ndarray, "rows s"]) -> Float[np.ndarray, "rows s"]:
        """Of what measuring a state adds."""
        return np.zeros_like(state)

    def drawn(self, population: Population, random: np.random.Generator, count: int) -> Float[np.ndarray, "count psi"]:
        """psi of a population that was inferred."""
        return normal_draws(population.loc, population.scale, random, count, self.least)
