"""Adaptive tempered sequential Monte Carlo of BlackJAX: no gradients, several modes are no obstacle.

Particles move from an initial density to the target along first^(1 - b) target^b, b as large at each stage as the
particles' effective number allows; all particles simulate in one batch. On the way few of them start chains of which
every state stays a particle (waste-free, Dau and Chopin 2022, algorithm 2); under the target all of them move.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.errors import SamplingFailed
from det2stoc_bayes.inference._sampling import (
    as_key,
    mode_of,
    normal_draws,
    numpy_random,
    per_chain,
    posterior_of,
    seed_of,
)
from det2stoc_bayes.posterior import DataTree, Progress, build, measured
from det2stoc_bayes.vector_density import AnyDensity, Inferred

LogDensity = Callable[[Float[np.ndarray, "points size"]], Float[np.ndarray, " points"]]
NUM_CHAINS = 4  # groups of particles; so that every method's result has the same shape
LOWEST = -1e10  # log density ratio where a simulation diverged: finite, so that 0 times it is 0
LEAST_STEP = 1e-9  # of b: below it tempering does not advance
DEGREES = 5  # of freedom of the Student-t about the mode
FEWEST_LAST = 2  # stages under the target, or one an unknown: a random walk forgets the more slowly
CHAIN = 10  # particles that one chain leaves on the way, if so many divide all of them
RESCALE = 2.38  # of a random walk's step: Roberts, Gelman and Gilks (1997)


@dataclass(frozen=True)
class Tempered:
    """Particles of the target, equally weighted, and how they got there."""

    particles: Float[np.ndarray, "particles size"]
    tempering: tuple[float, ...]  # b after each stage
    acceptance: tuple[float, ...]
    log_evidence: float  # log of the target's integral over the initial density's


def temper(
    log_first: LogDensity,
    log_target: LogDensity,
    particles: Float[np.ndarray, "particles size"],
    key: int | jax.Array,
    *,
    target_ess: float = 0.5,
    num_moves: int = 5,
    num_last: int = FEWEST_LAST,
    max_stages: int = 200,
    waste_free: bool = False,
    progress: Progress | None = None,
) -> Tempered:
    """Particles that were drawn from one density, moved to another; both are functions of batches, up to constants.

    `num_last` stages of `num_moves` move all under the target itself; before, so many move each, or `waste_free` each
    of fewer leaves every state. SamplingFailed: `max_stages` do not reach it.
    """
    import blackjax
    from blackjax.smc.resampling import systematic

    jax.config.update("jax_enable_x64", True)
    path, key = _Path(log_first, log_target), as_key(key)
    particles, alive = path.alive(np.asarray(particles, dtype=float), numpy_random(key))
    first, ratio = _for_jax(path.first), _for_jax(path.ratio)
    build = partial(
        blackjax.adaptive_tempered_smc.build_kernel, first, ratio, _walk, blackjax.rmh.init, systematic, target_ess
    )
    step = jax.jit(build(), static_argnums=2)
    on_the_way = jax.jit(build(update_strategy=_keeping(len(particles))), static_argnums=2) if waste_free else step
    state = blackjax.adaptive_tempered_smc.init(jnp.asarray(particles))
    tempering, acceptance, evidence = [0.0], [], float(np.log(alive))
    # A stage moves the particles under the b that was reached before: further ones move them under the target.
    while len(acceptance) < len(tempering) + num_last - 1:
        key, now = jax.random.split(key)
        there = {"root": _step_root(state.particles, state.weights)[None]}
        if waste_free and tempering[-1] < 1.0:
            state, info = on_the_way(now, state, None, there)
        else:
            state, info = step(now, state, num_moves, there)
        acceptance.append(float(info.update_info.acceptance_rate.mean()))
        if progress is not None:
            progress(len(acceptance), max_stages)
        reached = tempering[-1]
        if reached >= 1.0:
            continue
        tempering.append(min(float(state.tempering_param), 1.0))
        evidence += float(info.log_likelihood_increment)
        if len(tempering) > max_stages or not tempering[-1] > reached + LEAST_STEP:
            raise SamplingFailed(f"tempering came to {reached:.3g} of 1 in {len(acceptance)} of {max_stages} stages")
    return Tempered(np.asarray(state.particles), tuple(tempering[1:]), tuple(acceptance), evidence)


def _keeping(count: int) -> Callable:
    """An update after which every state of fewer chains is a particle."""
    from blackjax.smc.waste_free import waste_free_smc

    return waste_free_smc(count, max(n for n in range(1, CHAIN + 1) if count % n == 0))


def _walk(key, state, log_density, root):
    """One step of a random walk whose increments have covariance root root'."""
    import blackjax

    kernel = blackjax.additive_step_random_walk.build_kernel()
    return kernel(key, state, log_density, lambda k, position: root @ jax.random.normal(k, position.shape))


def _step_root(particles, weights) -> jax.Array:
    mean = weights @ particles
    size = particles.shape[1]
    covariance = (weights[:, None] * (particles - mean)).T @ (particles - mean)
    covariance += 1e-12 * jnp.trace(covariance) * jnp.eye(size)  # a single particle left has no spread
    return RESCALE / np.sqrt(size) * jnp.linalg.cholesky(covariance)


class _Path:
    """From the first density, where the target is not zero, to the target; every point is evaluated once."""

    def __init__(self, log_first: LogDensity, log_target: LogDensity):
        self._log_first, self._log_target = log_first, log_target
        self._seen: dict[bytes, tuple[float, float]] = {}

    def alive(
        self, particles: Float[np.ndarray, "particles size"], random: np.random.Generator
    ) -> tuple[Float[np.ndarray, "particles size"], float]:
        """Particles where the target is not zero, some of them repeated in place of the others; and their share."""
        finite = np.isfinite(self.first(particles))
        if not finite.any():
            raise SamplingFailed("the target is zero at every particle; allowed: an initial density that overlaps it")
        out = particles.copy()
        out[~finite] = particles[finite][random.integers(finite.sum(), size=(~finite).sum())]
        return out, float(finite.mean())

    def first(self, points: Float[np.ndarray, "points size"]) -> Float[np.ndarray, " points"]:
        """log of the first density; -inf where the target is zero (where its simulations diverge)."""
        return self._look_up(points)[:, 0]

    def ratio(self, points: Float[np.ndarray, "points size"]) -> Float[np.ndarray, " points"]:
        """log target - log first; finite everywhere, so that 0 times it is 0."""
        return self._look_up(points)[:, 1]

    def _look_up(self, points: np.ndarray) -> np.ndarray:
        keys = [row.tobytes() for row in points]
        new = {key: i for i, key in enumerate(keys) if key not in self._seen}
        if new:
            fresh = points[list(new.values())]
            first, target = self._log_first(fresh), self._log_target(fresh)
            dead = ~np.isfinite(first) | ~np.isfinite(target)
            first = np.where(dead, -np.inf, first)
            ratio = np.where(dead, LOWEST, target - np.where(dead, 0.0, first))
            self._seen.update(zip(new, zip(first.tolist(), ratio.tolist(), strict=True), strict=True))
        return np.array([self._seen[key] for key in keys])


def _for_jax(function: LogDensity):
    """A function of batches as a function of one point, which vmap makes one batch again."""

    def evaluate(points):
        points = np.ascontiguousarray(points, dtype=float)
        return function(points.reshape(-1, points.shape[-1])).reshape(points.shape[:-1])

    def single(point):
        return jax.pure_callback(evaluate, jax.ShapeDtypeStruct((), point.dtype), point, vmap_method="broadcast_all")

    return single


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    target_ess: float = 0.5,
    num_moves: int = 5,
    max_stages: int = 200,
    waste_free: bool = True,
    initial: Literal["prior", "mode"] = "prior",
    progress: Progress | None = None,
) -> DataTree:
    """`num_samples` particles, from the prior or from a wide Student-t about the mode (cheaper, but one mode)."""
    options = {
        "num_samples": num_samples,
        "target_ess": target_ess,
        "num_moves": num_moves,
        "max_stages": max_stages,
        "waste_free": waste_free,
        "initial": initial,
    }
    key = as_key(key)
    with measured(problem) as cost:
        random, count = numpy_random(key), NUM_CHAINS * per_chain(num_samples, NUM_CHAINS)
        density, log_first, particles = _beginning(problem, random, count, initial)
        moved = temper(
            log_first,
            density.log_density,
            particles,
            key,
            target_ess=target_ess,
            num_moves=num_moves,
            num_last=max(density.size, FEWEST_LAST),
            max_stages=max_stages,
            waste_free=waste_free,
            progress=progress,
        )
        # Neighbours may descend from one particle; chains are compared as if they were independent.
        z = random.permutation(moved.particles).reshape(NUM_CHAINS, -1, density.size)
        terms = density.log_likelihood_by_recording(z.reshape(-1, density.size)).reshape(*z.shape[:2], -1)
        return build(
            density,
            z,
            method="smc",
            options=options,
            seed=seed_of(key),
            cost=cost,
            sample_stats={
                "tempering": (("stage",), np.array(moved.tempering)),
                "acceptance_rate": (("move",), np.array(moved.acceptance)),
                "log_evidence": ((), moved.log_evidence),
            },
            log_likelihood=terms,
        )


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
