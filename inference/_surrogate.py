"""A study's posterior where a learned decoder stands in for the simulator: the density of psi's unknowns, and draws."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float, PRNGKeyArray
from numpyro.infer import MCMC, NUTS

from det2stoc_bayes.inference._amortized import Iteration, Population
from det2stoc_bayes.inference._cvae import Cvae, normal, standard_normal
from det2stoc_bayes.inference._episodes import Episodes
from det2stoc_bayes.inference._networks import Encoder
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.transitions import Transitions

NUM_WARMUP = 400
APART = 0.3  # prior sds between chains' starts: networks' valleys may have several bottoms
MOST_DOUBLINGS = 7  # leapfrog steps of one draw: 2 to this


@dataclass(frozen=True, eq=False)
class Surrogate:
    """Prior N(0, I) of a problem's unknowns z, and the decoder's density of each recording's transitions."""

    problem: Problem
    decoder: Callable[..., Any]
    believed: Population  # units in which the decoder knows psi
    episodes: Episodes  # one a recording, in the problem's order
    log_volume: float = 0.0  # of a transition's units: densities are of changes in their own

    @classmethod
    def of(cls, problem: Problem, turn: Iteration, real: Transitions) -> "Surrogate":
        """Of the problem's own recorded transitions, under a turn's decoder."""
        x, y = turn.simulator.scaling.standard(real)
        episodes = Episodes.of(turn.cvae, x, y, real.episode)
        return cls(problem, turn.cvae.decoder, turn.believed, episodes, turn.simulator.scaling.log_volume)

    @classmethod
    def under(
        cls, problem: Problem, simulator: StochasticSimulator, believed: Population, real: Transitions
    ) -> "Surrogate":
        """Of recorded transitions, under a simulator that learned without them."""
        decoder, scaling = simulator.decoder, simulator.scaling
        x, y = scaling.standard(real)
        size = len(believed.loc)
        guessing = Encoder(x.shape[1], y.shape[1], size, jax.random.key(0))  # which draws do not ask
        episodes = Episodes.of(Cvae(guessing, decoder, standard_normal(size), True), x, y, real.episode)
        return cls(problem, decoder, believed, episodes, scaling.log_volume)

    def terms(self, z: Float[Array, " size"]) -> Float[Array, " recordings"]:
        """log density of each recording."""
        psi = self.problem.unknowns.by_recording(z, jnp)
        latent = ((psi - self.believed.loc) / self.believed.scale).astype(jnp.float32)

        def one(latent: Array, x: Array, y: Array, weight: Array) -> Array:
            mean, scale = jax.vmap(self.decoder, (0, None))(x, latent)
            return (weight * (normal(mean, scale).log_prob(y) - self.log_volume)).sum()

        episodes = self.episodes
        return jax.vmap(one)(latent, episodes.x, episodes.y, episodes.weight)

    def draws(
        self, key: PRNGKeyArray, num_chains: int, num_draws: int
    ) -> tuple[Float[np.ndarray, "chain draw size"], dict[str, np.ndarray]]:
        """Draws by NUTS from about where the decoder's psi is centred, and its statistics."""
        size = self.problem.size

        def model() -> None:
            z = jnp.asarray(numpyro.sample("z", dist.Normal(jnp.zeros(size), 1.0).to_event(1)))
            numpyro.factor("recordings", self.terms(z).sum())

        kernel = NUTS(
            model,
            max_tree_depth=MOST_DOUBLINGS,
            dense_mass=True,
        )
        chains = MCMC(
            kernel,
            num_warmup=NUM_WARMUP,
            num_samples=num_draws,
            num_chains=num_chains,
            chain_method="vectorized",
            progress_bar=False,
        )
        first, go = jax.random.split(key)
        starts = self._centre() + APART * jax.random.normal(first, (num_chains, size))
        chains.run(go, init_params={"z": starts}, extra_fields=("potential_energy", "diverging"))
        extra = {name: np.asarray(v) for name, v in chains.get_extra_fields(group_by_chain=True).items()}
        return np.asarray(chains.get_samples(group_by_chain=True)["z"], float), extra

    def _centre(self) -> Float[np.ndarray, " size"]:
        z = np.zeros(self.problem.size)
        for block, loc in zip(self.problem.unknowns.blocks, self.believed.loc, strict=True):
            found = float(block.parameter.prior.to_normal(loc))
            z[block.begin] = np.clip(found, -3.0, 3.0)
        return z
