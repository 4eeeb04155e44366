"""Neural posterior estimation: a conditional flow learns the posterior from simulated recordings, in one round.

What is simulated is what the declared likelihood speaks of: whitened recordings without what other initial states could
explain, by how far they are from the real ones. Their principal components over the prior are the flow's input; since
the components are orthonormal, measurement noise is standard normal in each of them and is drawn anew in every step
of training, at no cost of simulations.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import Density
from det2stoc_bayes.errors import MethodNotApplicable, SimulationDiverged
from det2stoc_bayes.inference import _flow
from det2stoc_bayes.inference._flow import FEWEST, Training
from det2stoc_bayes.inference._refine import Refine, Weighed, build_weighed, num_proposed
from det2stoc_bayes.inference._sampling import NUM_CHAINS, as_key, density_of, numpy_random, per_chain, seed_of
from det2stoc_bayes.posterior import DataTree, Progress, measured
from det2stoc_bayes.problem import Problem

MOST_ROWS = 1000  # simulations that the components are found from
LEAST_SIGNAL = 0.01  # of the noise's variance: what a component tells less than this is nothing


def fit(
    problem: Problem,
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
    options: dict[str, Any] = {
        "num_samples": num_samples,
        "num_simulations": num_simulations,
        "num_features": num_features,
        "num_members": num_members,
        "width": width,
        "patience": patience,
        "num_epochs": num_epochs,
        "refine": refine,
    }
    each = num_proposed(per_chain(num_samples, NUM_CHAINS), refine)
    _refuse(problem, num_simulations)
    key = as_key(key)
    with measured(problem) as cost:
        density, random = density_of(problem), numpy_random(key)
        learn, draw = jax.random.split(key)
        z = random.standard_normal((num_simulations, density.size))
        z, signal, here = _simulated(density, z, num_features)
        training = Training(num_members=num_members, width=width, patience=patience, num_epochs=num_epochs)
        report = {} if progress is None else {"progress": progress}
        flow = _flow.train(z, signal, learn, training, noise=1.0, **report)
        drawn = flow.sample(draw, here, NUM_CHAINS * each)
        return build_weighed(
            density,
            Weighed.of(density, drawn, flow.log_density(drawn, here)),
            NUM_CHAINS,
            refine,
            random,
            sample_stats={"loss": (("epoch",), flow.history.mean(1))},
            method="npe",
            options=options,
            seed=seed_of(key),
            cost=cost,
        )


def _simulated(
    density: Density, z: Float[np.ndarray, "sims size"], num_features: int
) -> tuple[Float[np.ndarray, "whole size"], Float[np.ndarray, "whole features"], Float[np.ndarray, " features"]]:
    """z whose simulations stay finite, the components of these without noise, and those of the recordings.

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
    return z[whole], features[whole], -middle @ basis


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
