"""A study's experiment once more: psi from the prior, the same starts and commands, new noise."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.errors import SimulationDiverged
from det2stoc_bayes.map import find_map
from det2stoc_bayes.problem import Problem, make_problem
from det2stoc_bayes.recording import Recording

MOST_TRIES = 100  # psi whose simulation diverges are drawn again: a posterior excludes them as well


def fitted_start(problem: Problem) -> Start:
    """Where the recordings most probably began: every replication begins there."""
    return find_map(problem).point.start


def bare(problem: Problem) -> Problem:
    """The problem without the recordings that are not fitted, which a replication has none of."""
    return make_problem(problem.simulator.on(replace(problem.simulator.study, holdout=())))


def replicate(problem: Problem, start: Start, random: np.random.Generator) -> tuple[Problem, Mapping[str, float]]:
    """A problem of recordings simulated under psi from its prior, and the unknowns behind them (standard normals).

    Values are missing where the study's are; noise that the study does not declare is estimated anew.
    SimulationDiverged: no psi out of many can be simulated.
    """
    spreads = None if problem.unknowns.varying else problem.spreads
    believed = replace(problem, spreads=spreads)
    for _ in range(MOST_TRIES):
        z = random.standard_normal(believed.size)
        exact = problem.simulator.rollout(believed.request(z[None], start))
        if np.isfinite(exact).all():
            break
    else:
        raise SimulationDiverged(
            f"of {MOST_TRIES} psi from the prior not one can be simulated; allowed: narrower priors or a finer timestep"
        )
    values = _measured(problem, exact, random)
    recordings = tuple(
        _with_values(record, values[s], problem.segments.columns)
        for s, record in enumerate(problem.segments.recordings)
    )
    study = replace(problem.simulator.study, recordings=recordings, holdout=())
    return make_problem(problem.simulator.on(study)), dict(zip(believed.names, z.tolist(), strict=True))


def _measured(
    problem: Problem, exact: Float[np.ndarray, "segments samples columns"], random: np.random.Generator
) -> Float[np.ndarray, "segments samples columns"]:
    """With the declared noise; rotations of unit length, as they are read."""
    heavy = problem.measurement.degrees_of_freedom
    errors = random.standard_normal(exact.shape) if heavy is None else random.standard_t(heavy, exact.shape)
    values = exact + problem.noise * errors
    for group in problem.quaternions:
        values[..., group] /= np.linalg.norm(values[..., group], axis=-1, keepdims=True)
    return np.where(problem.segments.observed, values, np.nan)


def _with_values(
    record: Recording, values: Float[np.ndarray, "samples columns"], columns: tuple[str, ...]
) -> Recording:
    """A recording with other values; those of a segment are padded, and have all recordings' columns."""
    own = values[: len(record.time), [columns.index(c) for c in record.columns]]
    own.setflags(write=False)
    return replace(record, values=own)
