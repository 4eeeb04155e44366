"""How much of an experiment on a scene is done, and what all parts of a run share."""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from det2stoc_bayes.files import replacing
from det2stoc_bayes.models._runs import Runs
from det2stoc_bayes.reproduce.parts import Progress, kept
from det2stoc_bayes.reproduce.scene import Scene

STARTS = 8  # what episodes begin with and how they are measured: randomness beside that of psi


@dataclass(frozen=True)
class Settings:
    """How much is done; episodes have 100 transitions."""

    num_seeds: int = 5
    num_iterations: int = 5
    num_first: int = 10_000  # episodes under psi_0, simulated once for all seeds
    num_simulated: int = 1_200  # episodes of each later iteration, whose psi hardly differ
    first_steps: int = 12_000  # of training the decoder
    decoder_steps: int = 6_000
    baseline_steps: int = 8_000
    num_test: int = 50  # episodes
    num_draws: int = 1000
    num_oracle: int = 300  # draws: the fewer, the lower a matched Gaussian (by 0.07 nat at 300 in 18 numbers)
    num_alarm: int = 2_000  # episodes under each prior that the alarm is tried with; 0: it is not
    variants: bool = True  # what lies beyond the source's model
    baselines: tuple[int, ...] = (10, 100)  # episodes that each has
    episode_steps: int = 0  # of training the encoder of whole episodes; 0: their posteriors are the decoder's
    num_particles: int = 0  # of each recorded episode's posterior by the simulator itself; 0: it is not drawn
    num_marginal: int = 0  # episodes that the model without a latent learns from; 0: as many as an iteration


@dataclass(frozen=True, eq=False)
class Work:
    """What all parts of a run share."""

    out: Path
    scene: Scene
    settings: Settings
    seed: int
    progress: Progress

    @property
    def asked(self) -> dict[str, Any]:
        """What parts are made from beside the settings: seed, program and scene."""
        scene = zlib.crc32(self.scene.model.read_bytes())
        return {"seed": self.seed, "version": version("det2stoc-bayes"), "scene": scene}

    def random(self, *what: int) -> np.random.Generator:
        """Randomness for one purpose."""
        return np.random.default_rng([self.seed, *what])

    def key(self, purpose: str, *what: int) -> PRNGKeyArray:
        """The same for networks."""
        key = jax.random.fold_in(jax.random.key(self.seed), zlib.crc32(purpose.encode()))
        for number in what:
            key = jax.random.fold_in(key, number)
        return key

    def kept(self, name: str, make) -> dict[str, Any]:
        """A part's results, made under these settings."""
        return kept(self.out / "parts" / f"{name}.json", {**self.asked, **asdict(self.settings)}, make)

    def simulate(self, psi: Float[np.ndarray, "episodes psi"], stage: str, *what: int) -> Runs:
        """Episodes; `what` names their randomness."""
        return self.scene.simulate(psi, self.random(STARTS, *what), partial(self.progress, stage))

    def drawn(self, number: int) -> Float[np.ndarray, "episodes psi"]:
        """psi of a seed's recordings, of as many as any model of it learns from."""
        count = max(*self.settings.baselines, *self.scene.real_episodes)
        return self.scene.reality.draw(self.random(1, number), count)

    def recorded(self, number: int, first: int | None = None) -> Runs:
        """A seed's recordings, or the first of them; other noise is theirs then."""
        return self.simulate(self.drawn(number)[:first], "simulating the recordings", 1, number)

    def real(self, number: int) -> Runs:
        """Those of a seed's recordings that det2stoc learns from, as they were measured."""
        runs = self.arrays(f"real{number}_{len(self.drawn(number))}", lambda: self._measured(number))
        return Runs(runs["states"], runs["actions"], np.zeros((*runs["states"].shape[:2], 0)))

    def _measured(self, number: int) -> dict[str, np.ndarray]:
        runs = self.recorded(number)[: max(self.scene.real_episodes)]
        return {"states": runs.states, "actions": runs.actions}

    def arrays(self, name: str, make: Callable[[], dict[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
        """Arrays that were made before with this seed and scene, or are made and written now."""
        path = self.out / "parts" / f"{name}_{self.asked['scene']}_{self.seed}.npz"
        if not path.is_file():
            made = make()
            with replacing(path) as temporary, temporary.open("wb") as file:
                np.savez(file, allow_pickle=False, **made)
        return np.load(path)

    def model(self, number: int, name: str, make) -> dict[str, Any]:
        """What is told of a seed's model."""
        return self.kept(_stem(number, name), make)

    def saved(self, number: int, name: str) -> Path:
        """Where a seed's stochastic simulator is."""
        return self.out / "simulators" / f"{_stem(number, name)}.d2s"


def _stem(number: int, name: str) -> str:
    return f"seed{number}_{name.replace(' ', '_')}"
