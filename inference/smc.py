"""Tempered sequential Monte Carlo: no gradients, and several modes are no obstacle.

Particles go in groups that know nothing of each other, each from the initial density to the posterior: as between the
chains of other methods, what they disagree by says how far they can be trusted.
"""

import math
from collections.abc import Sequence
from itertools import zip_longest
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float
from scipy import stats

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.errors import MethodNotApplicable
from det2stoc_bayes.inference._sampling import (
    as_key,
    mode_of,
    normal_draws,
    numpy_random,
    per_chain,
    posterior_of,
    seed_of,
)
from det2stoc_bayes.inference._tempering import FEWEST_LAST, LogDensity, Tempering, temper
from det2stoc_bayes.posterior import DataTree, Progress, build, measured
from det2stoc_bayes.vector_density import AnyDensity, Inferred

__all__ = ["fit", "temper"]

NUM_CHAINS, FEWEST = 4, 10  # groups, and particles of each
FEW_UNKNOWNS = 6  # up to which chains are short enough: of 12 all is well, of 20 R-hat is 1.4 to 2.5
FEWEST_MOVES, MOVES_AN_UNKNOWN = 5, 0.3  # of 36 unknowns 5 are .22 sd and 29 % off, 10 .05 sd and 3 to 7 %
DEGREES = 5  # of freedom of the Student-t about the mode


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    target_ess: float = 0.5,
    num_moves: int | None = None,
    max_stages: int = 200,
    waste_free: bool | None = None,
    initial: Literal["prior", "mode"] = "prior",
    progress: Progress | None = None,
) -> DataTree:
    """`num_samples` particles, from the prior or from a wide Student-t about the mode (cheaper, but one mode).

    Each makes `num_moves` steps a stage (None: the more, the more unknowns), and as many stages under the posterior as
    there are unknowns. `waste_free` (None: where unknowns are few) chains make their own number on the way; short ones
    forget where they began in few directions alone. MethodNotApplicable: too few of any.
    """
    options = {
        "num_samples": num_samples,
        "target_ess": target_ess,
        "num_moves": num_moves,
        "max_stages": max_stages,
        "waste_free": waste_free,
        "initial": initial,
    }
    each = per_chain(num_samples, NUM_CHAINS)
    for name, found, least in (("num_samples", num_samples, NUM_CHAINS * FEWEST), ("num_moves", num_moves, 1)):
        if found is not None and found < least:
            raise MethodNotApplicable(f"smc: found {name} = {found}; allowed: {least} at least")
    key = as_key(key)
    with measured(problem) as cost:
        random = numpy_random(key)
        density, log_first, particles = _beginning(problem, random, NUM_CHAINS * each, initial)
        kept = density.size <= FEW_UNKNOWNS if waste_free is None else waste_free
        moves = num_moves or moves_for(density.size)
        options |= {"num_moves": moves, "waste_free": kept}
        way = Tempering(log_first, density.log_density, each, target_ess=target_ess, num_moves=moves, waste_free=kept)
        told = progress or (lambda *_: None)
        moved = []
        for k, group in enumerate(np.split(particles, NUM_CHAINS)):
            own = jax.random.fold_in(key, k)
            moved.append(way.run(group, own, num_last=max(density.size, FEWEST_LAST), max_stages=max_stages))
            told(k + 1, NUM_CHAINS)
        evidence = np.logaddexp.reduce([one.log_evidence for one in moved]) - np.log(NUM_CHAINS)
        cost.seconds_compile = way.seconds_compile
        # Neighbours of a group may descend from one particle, and would look like a chain that hardly moves.
        z = np.stack([random.permutation(one.particles) for one in moved])
        terms = density.log_likelihood_by_recording(z.reshape(-1, density.size)).reshape(*z.shape[:2], -1)
        return build(
            density,
            z,
            method="smc",
            options=options,
            seed=seed_of(key),
            cost=cost,
            sample_stats={
                "tempering": (("group", "stage"), _in_rows([one.tempering for one in moved])),
                "acceptance_rate": (("group", "move"), _in_rows([one.acceptance for one in moved])),
                "log_evidence": ((), float(evidence)),
            },
            log_likelihood=terms,
        )


def moves_for(size: int) -> int:
    """Steps a stage that so many unknowns take."""
    return max(FEWEST_MOVES, math.ceil(MOVES_AN_UNKNOWN * size))


def _in_rows(rows: Sequence[Sequence[float]]) -> Float[np.ndarray, "rows longest"]:
    """Rows of different lengths as an array, NaN where they end."""
    return np.array(list(zip_longest(*rows, fillvalue=np.nan))).T


def _beginning(
    problem: Inferred, random: np.random.Generator, count: int, initial: str
) -> tuple[AnyDensity, LogDensity, Float[np.ndarray, "particles size"]]:
    """The density, and the normalized initial one with its particles."""
    if initial == "prior":
        density = posterior_of(problem)
        return density, log_prior, random.standard_normal((count, density.size))
    mode = mode_of(problem)
    wide = stats.multivariate_t(np.zeros(mode.density.size), df=DEGREES)
    centred = normal_draws(mode, random, count) - mode.center
    log_det = float(np.log(np.diag(mode.scale)).sum())

    def log_first(z):
        u = np.linalg.solve(mode.scale, (z - mode.center).T).T
        return np.reshape(wide.logpdf(u), len(z)) - log_det

    heavy = np.sqrt(DEGREES / random.chisquare(DEGREES, count))[:, None]
    return mode.density, log_first, mode.center + heavy * centred
