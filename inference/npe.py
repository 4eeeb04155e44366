"""Neural posterior estimation: a conditional flow learns the posterior from simulated recordings, in one round.

What is simulated is what the declared likelihood speaks of: whitened recordings without what other initial states could
explain, by how far they are from the real ones. Their principal components over the prior are the flow's input; since
the components are orthonormal, measurement noise is standard normal in each of them and is drawn anew in every step
of training, at no cost of simulations. What was learned once serves for others than the real recordings as well, by
how far these are from them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import Density
from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.errors import MethodNotApplicable, SimulationDiverged
from det2stoc_bayes.inference import _flow, _vectors
from det2stoc_bayes.inference._flow import FEWEST, ConditionalFlow, Training
from det2stoc_bayes.inference._refine import Refine, Weighed, build_weighed, num_proposed
from det2stoc_bayes.inference._sampling import NUM_CHAINS, as_key, density_of, numpy_random, per_chain, seed_of
from det2stoc_bayes.likelihood import LatentStarts
from det2stoc_bayes.linearization import tangent
from det2stoc_bayes.posterior import Cost, DataTree, Progress, measured
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.vector_density import Inferred
from det2stoc_bayes.vector_problem import Posed

MOST_ROWS = 1000  # simulations that the components are found from
LEAST_SIGNAL = 0.01  # of the noise's variance: what a component tells less than this is nothing


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    num_simulations: int = 5_000,
    num_features: int = 32,
    num_members: int = 4,
    width: int = 64,
    patience: int = 20,
    num_epochs: int = 300,
    refine: Refine = "none",
    progress: Progress | None = None,
) -> DataTree:
    """Draws of the learned posterior; `sample_stats.loss`: validation loss of each epoch, mean over the members.

    Recordings are read by at most `num_features` principal components; `num_members` flows learn until the loss has
    not improved for `patience` epochs. `refine`: "psis" resamples by the exact likelihood.
    """
    learning = {
        "num_simulations": num_simulations,
        "num_features": num_features,
        "num_members": num_members,
        "width": width,
        "patience": patience,
        "num_epochs": num_epochs,
    }
    return refinements(problem, key, [refine], num_samples=num_samples, progress=progress, **learning)[0]


def refinements(
    problem: Inferred,
    key: int | jax.Array,
    refines: Sequence[Refine],
    *,
    num_samples: int = 1000,
    num_simulations: int = 5_000,
    num_features: int = 32,
    num_members: int = 4,
    width: int = 64,
    patience: int = 20,
    num_epochs: int = 300,
    progress: Progress | None = None,
) -> list[DataTree]:
    """As `fit`, for each `refine` by the same learning, whose cost each result bears."""
    learning = {
        "num_simulations": num_simulations,
        "num_features": num_features,
        "num_members": num_members,
        "width": width,
        "patience": patience,
        "num_epochs": num_epochs,
    }
    options = {"num_samples": num_samples} | learning
    if isinstance(problem, Posed):
        told = progress or (lambda *_: None)
        return [_vectors.fit(problem, key, options | {"refine": refine}, told) for refine in refines]
    each = [num_proposed(per_chain(num_samples, NUM_CHAINS), refine) for refine in refines]
    _refuse(problem, num_simulations)
    learn, draw = jax.random.split(key := as_key(key))
    with measured(problem) as cost:
        density, random = density_of(problem), numpy_random(key)
        trained = _learned(density, random, learn, progress, **learning)
        return [
            _tree(trained, density, draw, random, count, how, options | {"refine": how}, seed_of(key), cost)
            for how, count in zip(refines, each, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class Trained:
    """What was learned from simulations of a problem's recordings, and how others like these are read by it."""

    flow: ConditionalFlow
    recordings: tuple[Recording, ...]  # that were imitated
    values: Float[np.ndarray, "segments samples columns"]
    start: Start
    offset: Float[np.ndarray, "segments states"]
    latent: LatentStarts
    middle: Float[np.ndarray, " values"]  # of the simulated signals
    basis: Float[np.ndarray, "values features"]
    options: Mapping[str, Any]

    def features(self, problem: Problem) -> Float[np.ndarray, " features"]:
        """The components of a problem's recordings; MethodNotApplicable where they are not of the same kind."""
        self._same_plan(problem.segments.recordings)
        error = problem.residuals(self.values).reshape(problem.segments.count, -1) * self.latent.weight
        apart = tangent(problem, self.start) - self.offset
        change = self.latent.project(self.latent.stack_whitened(error[..., None], apart[..., None]))
        return (change.ravel() - self.middle) @ self.basis

    def _same_plan(self, recordings: tuple[Recording, ...]) -> None:
        """Names, columns, clocks, commands and what is missing have to be those that were imitated."""
        for known, given in zip_longest(self.recordings, recordings):
            if known is None or given is None or not _alike(known, given):
                name = next((r.name for r in (given, known) if r is not None), "")
                raise MethodNotApplicable(
                    f"npe: recording {name} differs in more than its values from what was learned from; allowed: the "
                    "same recordings, columns, times, commands and missing samples"
                )


def _alike(a: Recording, b: Recording) -> bool:
    """Whether they have the same besides their values."""
    pairs = (a.time, b.time), (a.ctrl, b.ctrl), (np.isfinite(a.values), np.isfinite(b.values))
    return (a.name, a.columns) == (b.name, b.columns) and all(np.array_equal(x, y) for x, y in pairs)


def train(
    problem: Problem,
    key: int | jax.Array,
    *,
    num_simulations: int = 5_000,
    num_features: int = 32,
    num_members: int = 4,
    width: int = 64,
    patience: int = 20,
    num_epochs: int = 300,
) -> Trained:
    """Flows that serve for any values that recordings like the problem's may have, from about the same starts.

    What initial states explain and how large noise is are found at the problem's own recordings.
    """
    _refuse(problem, num_simulations)
    return _learned(
        density_of(problem),
        numpy_random(key := as_key(key)),
        jax.random.split(key)[0],
        num_simulations=num_simulations,
        num_features=num_features,
        num_members=num_members,
        width=width,
        patience=patience,
        num_epochs=num_epochs,
    )


def apply(
    trained: Trained, problem: Problem, key: int | jax.Array, *, num_samples: int = 1000, refine: Refine = "none"
) -> DataTree:
    """As `fit`, without its learning; of other recordings than those that `train` saw."""
    options = {"num_samples": num_samples, "refine": refine} | dict(trained.options)
    each = num_proposed(per_chain(num_samples, NUM_CHAINS), refine)
    key = as_key(key)
    with measured(problem) as cost:
        return _tree(trained, density_of(problem), key, numpy_random(key), each, refine, options, seed_of(key), cost)


def _learned(
    density: Density,
    random: np.random.Generator,
    key: jax.Array,
    progress: Progress | None = None,
    *,
    num_simulations: int,
    num_features: int,
    **training: int,
) -> Trained:
    z, signal, middle, basis = _simulated(
        density, random.standard_normal((num_simulations, density.size)), num_features
    )
    report = {} if progress is None else {"progress": progress}
    flow = _flow.train(z, signal, key, Training(**training), noise=1.0, **report)
    own, options = density.problem.segments, {"num_simulations": num_simulations, "num_features": num_features}
    return Trained(
        flow, own.recordings, own.values, density.start, density.offset, density.latent, middle, basis,
        options | training,
    )  # fmt: skip


def _tree(
    trained: Trained,
    density: Density,
    key: jax.Array,
    random: np.random.Generator,
    each: int,
    refine: Refine,
    options: Mapping[str, Any],
    seed: int,
    cost: Cost,
) -> DataTree:
    """Draws of the flow, weighed by the exact likelihood."""
    here = trained.features(density.problem)
    drawn = trained.flow.sample(key, here, NUM_CHAINS * each)
    return build_weighed(
        density,
        Weighed.of(density, drawn, trained.flow.log_density(drawn, here)),
        NUM_CHAINS,
        refine,
        random,
        sample_stats={"loss": (("epoch",), trained.flow.history.mean(1))},
        method="npe",
        options=options,
        seed=seed,
        cost=cost,
    )


def _simulated(
    density: Density, z: Float[np.ndarray, "sims size"], num_features: int
) -> tuple[
    Float[np.ndarray, "whole size"],
    Float[np.ndarray, "whole features"],
    Float[np.ndarray, " values"],
    Float[np.ndarray, "values features"],
]:
    """z whose simulations stay finite, the components of these without noise, the signals' mean and the directions.

    SimulationDiverged: too few are left.
    """
    z, beyond = density.walled(z)
    z = z[~beyond]
    first, rest = z[:MOST_ROWS], z[MOST_ROWS:]
    begun = np.concatenate([_signals(density, first[rows]) for rows in density.chunks(len(first))])
    finite = np.isfinite(begun).all(1)
    if finite.sum() < FEWEST:
        raise SimulationDiverged(
            f"of {len(first)} simulations under the prior {finite.sum()} stay finite; allowed: {FEWEST} at least, "
            "by narrower priors or a finer timestep"
        )
    middle = begun[finite].mean(0)
    basis = _components(begun[finite] - middle, num_features)
    parts = [(_signals(density, rest[rows]) - middle) @ basis for rows in density.chunks(len(rest))]
    features = np.concatenate([(begun - middle) @ basis, *parts])
    whole = np.isfinite(features).all(1)
    return z[whole], features[whole], middle, basis


def _signals(density: Density, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points values"]:
    """Simulated minus real recordings without noise, whitened; NaN where a simulation diverged."""
    return -np.moveaxis(density.projected(z), -1, 0).reshape(len(z), -1)


def _components(signal: Float[np.ndarray, "sims values"], most: int) -> Float[np.ndarray, "values features"]:
    """Orthonormal directions of the most variance, in units of the noise; one at least."""
    _, size, directions = np.linalg.svd(signal, full_matrices=False)
    told = size**2 / len(signal) > LEAST_SIGNAL
    return directions[: max(1, min(most, int(told.sum())))].T


def _refuse(problem: Problem, num_simulations: int) -> None:
    if problem.measurement.degrees_of_freedom is not None:
        raise MethodNotApplicable(
            "npe: noise is student_t, and simulated noise is Gaussian; allowed: a method that weighs recordings by "
            "their density, as nuts or smc"
        )
    if num_simulations < FEWEST:
        raise MethodNotApplicable(f"npe: found num_simulations = {num_simulations}; allowed: {FEWEST} at least")
