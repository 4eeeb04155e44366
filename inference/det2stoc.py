"""det2stoc: transitions simulated under psi train a decoder, which is frozen and then read backwards on recordings.

After the algorithm's last turn every recording's transitions are weighed by its decoder, which gives the posterior of
psi without simulating; the exact likelihood of each draw stands beside it (`log_weight`: exact less learned), and
says whether the posterior can be trusted, and by which `refine="psis"` corrects it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from det2stoc_bayes.density import Density
from det2stoc_bayes.inference._amortized import Iteration, Options, Population, iterate, pretrain
from det2stoc_bayes.inference._predictive import heldout_transitions, kept, predictions
from det2stoc_bayes.inference._refine import Refine, Weighed, build_weighed, num_proposed
from det2stoc_bayes.inference._sampling import as_key, density_of, numpy_random, of_study, per_chain, seed_of
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.inference._surprise import surprise
from det2stoc_bayes.inference._surrogate import Surrogate
from det2stoc_bayes.posterior import Cost, DataTree, Progress, measured, with_groups
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.study_transitions import StudyTransitions
from det2stoc_bayes.transitions import Scaling, Transitions
from det2stoc_bayes.unknowns import of_population, population_draws
from det2stoc_bayes.vector_density import Inferred

NUM_CHAINS = 4
FARTHEST = 2.5  # prior sds: psi of the first simulations, lest a heavy tail set the units
WIDER = 3.0  # posterior sds: how a psi that does not vary is simulated next, lest a turn's error exclude the truth


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    num_iterations: int = 3,
    num_simulated: int = 10_000,
    num_steps: int = 4_000,
    refine: Refine = "none",
    progress: Progress = lambda *_: None,
) -> DataTree:
    """Draws of psi under the learned likelihood; group `turns`: what each turn of the algorithm inferred.

    Groups `simulator`: the stochastic simulator of the last turn (`learned_simulator` reads it); `surprise`: whether
    the recordings lie among the simulations.

    `num_simulated` stretches of recordings are simulated a turn, `num_steps` steps train its decoder. `refine`:
    "psis" resamples by the exact likelihood.
    """
    learning = {"num_iterations": num_iterations, "num_simulated": num_simulated, "num_steps": num_steps}
    return refinements(problem, key, [refine], num_samples=num_samples, progress=progress, **learning)[0]


def refinements(
    problem: Inferred,
    key: int | jax.Array,
    refines: Sequence[Refine],
    *,
    num_samples: int = 1000,
    num_iterations: int = 3,
    num_simulated: int = 10_000,
    num_steps: int = 4_000,
    progress: Progress = lambda *_: None,
) -> list[DataTree]:
    """As `fit`, for each `refine` by the same learning, whose cost each result bears."""
    options = {
        "num_samples": num_samples,
        "num_iterations": num_iterations,
        "num_simulated": num_simulated,
        "num_steps": num_steps,
    }
    problem = of_study(problem, "det2stoc", "has no transitions to learn from")
    for refine in refines:
        num_proposed(1, refine)  # what it may be, told before the work
    key = as_key(key)
    learn, draw, judge = jax.random.split(key, 3)
    look = jax.random.fold_in(judge, 1)
    with measured(problem) as cost:
        density = density_of(problem)
        transitions = StudyTransitions.of(density.problem)
        real, heldout, stages = transitions.recorded(), heldout_transitions(transitions), num_iterations + 1
        turns: list[Iteration] = []
        for turn in _turns(transitions, real, learn, num_iterations, num_simulated, num_steps):
            turns.append(turn)
            progress(len(turns), stages)
        surrogate = Surrogate.of(density.problem, turns[-1], real)
        trees = [
            _tree(density, surrogate, (draw, judge), num_samples, how, options | {"refine": how}, seed_of(key), cost)
            for how in refines
        ]
        progress(stages, stages)
        simulator = turns[-1].predictive
        told = predictions(simulator, transitions, heldout, judge)
        unlike = surprise(turns[0], transitions, numpy_random(look))
    groups = {"turns": _told(density.problem, turns), "surprise": unlike.told(), "predictions": told}
    return [with_groups(tree, **groups, simulator=kept(simulator, transitions)) for tree in trees]


@dataclass(frozen=True, eq=False)
class Trained:
    """The algorithm's first turn without its recordings: what learned from simulations under the prior."""

    simulator: bytes  # the stochastic simulator, as `from_bytes` reads it
    believed: Population
    options: Mapping[str, int]


def train(problem: Problem, key: int | jax.Array, *, num_simulated: int = 10_000, num_steps: int = 4_000) -> Trained:
    """A decoder that serves for any values that recordings like the problem's may have: `apply` infers psi by it."""
    simulate, learn = jax.random.split(as_key(key))
    random = numpy_random(simulate)
    psi = _from_prior(problem, random, num_simulated)
    believed = Population.of(psi)
    simulated = StudyTransitions.of(problem).simulated(psi, random)
    scaling, z = Scaling.of(simulated), believed.standard(psi[simulated.episode])
    decoder, _ = pretrain(simulated, z, scaling, learn, Options.decoding(num_steps), lambda *_: None)
    learned = StochasticSimulator(decoder, scaling).to_bytes()
    return Trained(learned, believed, {"num_simulated": num_simulated, "num_steps": num_steps})


def apply(
    trained: Trained, problem: Problem, key: int | jax.Array, *, num_samples: int = 1000, refine: Refine = "none"
) -> DataTree:
    """As `fit` with one iteration, without its learning; of other recordings than those that `train` saw."""
    options = {"num_samples": num_samples, "num_iterations": 1, "refine": refine} | dict(trained.options)
    num_proposed(1, refine)
    draw, judge = jax.random.split(key := as_key(key))
    with measured(problem) as cost:
        density = density_of(problem)
        real = StudyTransitions.of(density.problem).recorded()
        simulator = StochasticSimulator.from_bytes(trained.simulator)
        surrogate = Surrogate.under(density.problem, simulator, trained.believed, real)
        return _tree(density, surrogate, (draw, judge), num_samples, refine, options, seed_of(key), cost)


def _tree(
    density: Density,
    surrogate: Surrogate,
    keys: tuple[jax.Array, jax.Array],
    num_samples: int,
    refine: Refine,
    options: Mapping[str, Any],
    seed: int,
    cost: Cost,
) -> DataTree:
    """Draws under the learned likelihood, weighed by the exact one."""
    each = num_proposed(per_chain(num_samples, NUM_CHAINS), refine)
    z, stats = surrogate.draws(keys[0], NUM_CHAINS, each)
    drawn = Weighed.of(density, z.reshape(-1, density.size), -stats["potential_energy"].reshape(-1))
    return build_weighed(
        density,
        drawn,
        NUM_CHAINS,
        refine,
        numpy_random(keys[1]),
        sample_stats={"diverging": stats["diverging"]},
        method="det2stoc",
        options=options,
        seed=seed,
        cost=cost,
    )


def _turns(
    transitions: StudyTransitions, real: Transitions, key: jax.Array, count: int, num_simulated: int, num_steps: int
) -> Iterator[Iteration]:
    """The algorithm's turns: each simulates under the population that the last one found."""
    problem, random = transitions.problem, numpy_random(key)
    options = Options.decoding(num_steps)
    varies = np.array([p.varies == "trajectory" for p in problem.simulator.parameters])
    psi = _from_prior(problem, random, num_simulated)
    believed = Population.of(psi)
    for k in jax.random.split(key, count):
        simulated = transitions.simulated(psi, random)
        turn = iterate(real, simulated, psi[simulated.episode], believed, k, options, varies=varies)
        yield turn
        found = turn.next_population
        believed = Population(found.loc, np.where(varies, found.scale, np.minimum(WIDER * found.scale, believed.scale)))
        psi = _drawn(problem, believed, random, num_simulated)


def _from_prior(problem: Problem, random: np.random.Generator, count: int) -> np.ndarray:
    """psi of an episode to come under the priors, without their farthest tails."""
    columns = []
    for p in problem.simulator.parameters:
        z = random.standard_normal(2 * count)
        z = np.resize(z[np.abs(z) < FARTHEST], count)
        values = np.asarray(p.prior.from_normal(z))
        if p.varies == "trajectory":
            sigma = np.abs(random.normal(0.0, p.prior.sd / 2, count))
            values = np.asarray(of_population(p, values, sigma, random.standard_normal(count)))
        columns.append(values)
    return np.stack(columns, 1)


def _drawn(problem: Problem, population: Population, random: np.random.Generator, count: int) -> np.ndarray:
    """psi of a population, within the priors' supports."""
    parameters = problem.simulator.parameters
    normal = random.standard_normal((len(parameters), count)).T
    return population_draws(parameters, population.loc, population.scale, normal)


def _told(problem: Problem, turns: list[Iteration]) -> dict:
    """What each turn believed and found, by psi. `pooled` is over all transitions' q: the source's figure.

    `outside`: probability that the population's mean lies beyond all psi that were simulated; `alarm`: of any psi.
    """
    columns = {
        "simulated_mean": [t.believed.loc for t in turns],
        "simulated_sd": [t.believed.scale for t in turns],
        "pooled_mean": [t.pooled.loc for t in turns],
        "pooled_sd": [t.pooled.scale for t in turns],
        "population_mean": [t.mean_draws.mean(0) for t in turns],
        "population_sd": [t.sd_draws.mean(0) for t in turns],
        "divergence": [t.divergences for t in turns],
        "outside": [t.outside.mean(0) for t in turns],
    }
    names = np.array([p.name for p in problem.simulator.parameters])
    told: dict[str, Any] = {name: (("turn", "psi"), np.stack(values)) for name, values in columns.items()}
    told["alarm"] = ("turn",), np.array([t.alarm for t in turns])
    return told | {"psi": (("psi",), names), "turn": (("turn",), np.arange(1, len(turns) + 1))}
