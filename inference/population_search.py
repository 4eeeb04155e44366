"""Mean and spread of psi by an evolution strategy on the discrepancy between simulated and recorded trajectories.

The way of simulation-parameter randomization: simulations under psi ~ Normal(mu, sigma) shall scatter about the
recordings as these do. The discrepancy is the energy score (Gneiting and Raftery 2007, eq. 21), which is least where
the distributions are equal; the search is CMA-ES (Hansen and Ostermeier 2001). What is found is one population, not
a posterior of it: where psi never varies, its spread tells what the discrepancy cannot see.
"""

import jax
import numpy as np
from cmaes import CMA
from jaxtyping import Float

from det2stoc_bayes.density import Density
from det2stoc_bayes.errors import MethodNotApplicable, SamplingFailed
from det2stoc_bayes.inference._sampling import (
    NUM_CHAINS,
    as_key,
    density_of,
    numpy_random,
    of_study,
    per_chain,
    seed_of,
)
from det2stoc_bayes.metrics import energy_score
from det2stoc_bayes.posterior import DataTree, Progress, build, measured
from det2stoc_bayes.problem import repeat_start
from det2stoc_bayes.unknowns import of_population, population_draws
from det2stoc_bayes.vector_density import Inferred

FARTHEST = 4.0  # prior sds of mu from the prior's median
SPREADS = (1e-3, 1.5)  # least and largest sigma, in prior sds
FIRST = (0.0, float(np.log(0.3)), 0.5)  # mu and log sigma where the search begins, and its first step


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    num_generations: int = 40,
    num_draws: int = 16,
    progress: Progress = lambda *_: None,
) -> DataTree:
    """Draws of the population that was found; `sample_stats` has the discrepancy of each generation.

    `num_draws` simulations of every stretch of the recordings tell the discrepancy of one population.
    """
    problem = of_study(problem, "population_search", "has no trajectories to simulate again")
    if not problem.num_psi:
        raise MethodNotApplicable("population_search: the study has no psi to search; allowed: a study with one")
    options = {"num_samples": num_samples, "num_generations": num_generations, "num_draws": num_draws}
    key = as_key(key)
    with measured(problem) as cost:
        random = numpy_random(key)
        search = _Search.of(density_of(problem), num_draws, random)
        best, history = _evolved(search, num_generations, random, progress)
        z = search.draws(best, NUM_CHAINS * per_chain(num_samples, NUM_CHAINS), random)
        density = search.density
        terms = density.log_likelihood_by_recording(z)
        return build(
            density,
            z.reshape(NUM_CHAINS, -1, density.size),
            method="population_search",
            options=options,
            seed=seed_of(key),
            cost=cost,
            sample_stats={"discrepancy": (("generation",), history)},
            log_likelihood=terms.reshape(NUM_CHAINS, len(z) // NUM_CHAINS, -1),
        )


class _Search:
    """Populations (mu in prior sds from its median, log sigma in prior sds; one pair a psi) and their discrepancies."""

    def __init__(self, density: Density, normal: np.ndarray, noise: np.ndarray):
        self.density, self.normal, self.noise = density, normal, noise
        self.problem, self.parameters = density.problem, density.problem.simulator.parameters

    @classmethod
    def of(cls, density: Density, num_draws: int, random: np.random.Generator) -> "_Search":
        """The same random numbers serve all populations: the discrepancy is a smooth function."""
        segments, size = density.problem.segments, len(density.problem.simulator.parameters)
        normal = random.standard_normal((num_draws, segments.count, size))
        return cls(density, normal, random.standard_normal((num_draws, *density.problem.weight.shape)))

    def population(
        self, x: Float[np.ndarray, " unknowns"]
    ) -> tuple[Float[np.ndarray, " psi"], Float[np.ndarray, " psi"]]:
        """mu and sigma of each psi, in its own units."""
        mu = [p.prior.from_normal(m) for p, m in zip(self.parameters, x[::2], strict=True)]
        sigma = [np.exp(s) * p.prior.sd for p, s in zip(self.parameters, x[1::2], strict=True)]
        return np.array(mu), np.array(sigma)

    def discrepancies(self, candidates: Float[np.ndarray, "many unknowns"]) -> Float[np.ndarray, " many"]:
        """Mean energy score of the recordings' stretches, in noise sds; infinite where no simulation is left."""
        problem, parameters = self.problem, self.parameters
        drawn = [population_draws(parameters, *self.population(x), self.normal) for x in candidates]
        psi = np.stack(drawn)  # candidates, draws, segments, psi
        start = repeat_start(self.density.start, len(candidates) * len(self.normal))
        request = problem.request_under(psi.reshape(-1, psi.shape[-1]), start)
        off = -problem.residuals(problem.simulator.rollout(request))  # of the prediction from the recorded values
        off = off.reshape(*psi.shape[:3], -1) * problem.weight + self.noise * (problem.weight > 0)
        return np.array([self._score(o) for o in off])

    def _score(self, off: Float[np.ndarray, "draws segments values"]) -> float:
        fine = off[np.isfinite(off).all((1, 2))]
        if len(fine) < 2:
            return float("inf")
        lost = len(off) / len(fine)  # what diverges is no prediction
        return lost * float(energy_score(fine, np.zeros(fine.shape[1:])).mean())

    def draws(
        self, x: Float[np.ndarray, " unknowns"], count: int, random: np.random.Generator
    ) -> Float[np.ndarray, "draws size"]:
        """z of the population's draws."""
        z = random.standard_normal((count, self.problem.size))
        mu, sigma = self.population(x)
        for i, (p, block) in enumerate(zip(self.parameters, self.problem.unknowns.blocks, strict=True)):
            if block.varies:
                z[:, block.begin] = x[2 * i]
                z[:, block.begin + 1] = block.sigma_prior.to_normal(sigma[i])
            else:
                z[:, block.begin] = p.prior.to_normal(of_population(p, mu[i], sigma[i], z[:, block.begin]))
        return z


def _evolved(
    search: _Search, num_generations: int, random: np.random.Generator, progress: Progress
) -> tuple[Float[np.ndarray, " unknowns"], Float[np.ndarray, " generations"]]:
    """The strategy's last mean, and the least discrepancy of each generation."""
    size = len(search.parameters)
    bounds = np.tile([[-FARTHEST, FARTHEST], list(np.log(SPREADS))], (size, 1))
    strategy = CMA(np.tile(FIRST[:2], size), FIRST[2], bounds=bounds, seed=int(random.integers(2**31)))
    history = []
    for generation in range(num_generations):
        asked = np.stack([strategy.ask() for _ in range(strategy.population_size)])
        found = search.discrepancies(asked)
        worst = found[np.isfinite(found)].max(initial=-np.inf)
        if not np.isfinite(worst):
            raise SamplingFailed("population_search: no simulation of a population stays finite; allowed: other priors")
        strategy.tell([(x, float(min(value, 2 * worst + 1))) for x, value in zip(asked, found, strict=True)])
        history.append(found.min())
        progress(generation + 1, num_generations)
        if strategy.should_stop():
            break
    return strategy.mean, np.array(history)
