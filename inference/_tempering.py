"""Adaptive tempered sequential Monte Carlo of BlackJAX: from an initial density to the target, in stages.

Particles move along first^(1 - b) target^b, b as large at each stage as the particles' effective number allows; all
simulate in one batch. Waste-free (Dau and Chopin 2022, algorithm 2) every state of fewer chains stays a particle on
the way, and under the target all of them move.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.errors import SamplingFailed
from det2stoc_bayes.inference._sampling import as_key, numpy_random
from det2stoc_bayes.posterior import Progress

LogDensity = Callable[[Float[np.ndarray, "points size"]], Float[np.ndarray, " points"]]
LOWEST = -1e10  # log density ratio where a simulation diverged: finite, so that 0 times it is 0
LEAST_STEP = 1e-9  # of b: below it tempering does not advance
FEWEST_LAST = 2  # stages under the target, or one an unknown: a random walk forgets the more slowly
LONGEST_CHAIN, FEWEST_CHAINS = 10, 20  # of the particles that a waste-free stage leaves
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
    **options: Any,
) -> Tempered:
    """Particles that were drawn from one density, moved to another; both are functions of batches, up to constants.

    `options` are those of `Tempering` and of its `run`, whose errors are raised.
    """
    run = {name: options.pop(name) for name in ("num_last", "max_stages", "progress") if name in options}
    return Tempering(log_first, log_target, len(particles), **options).run(particles, key, **run)


class Tempering:
    """The way from one density to another for so many particles at a time; compiled once, run as often as wanted.

    Each stage every particle makes `num_moves` steps of a random walk; `waste_free` instead few chains leave all.
    """

    def __init__(
        self,
        log_first: LogDensity,
        log_target: LogDensity,
        count: int,
        *,
        target_ess: float = 0.5,
        num_moves: int = 5,
        waste_free: bool = False,
    ):
        import blackjax
        from blackjax.smc.resampling import systematic
        from blackjax.smc.waste_free import waste_free_smc

        jax.config.update("jax_enable_x64", True)
        self._path, self._num_moves = _Path(log_first, log_target), num_moves
        densities = _for_jax(self._path.first), _for_jax(self._path.ratio)
        build = partial(
            blackjax.adaptive_tempered_smc.build_kernel, *densities, _walk, blackjax.rmh.init, systematic, target_ess
        )
        self._moves = {"all": jax.jit(build(), static_argnums=2)}
        chain = chain_length(count) if waste_free else 1
        if chain > 1:
            self._moves["few"] = jax.jit(build(update_strategy=waste_free_smc(count, chain)), static_argnums=2)
        self._compiled: dict[str, Callable[..., Any]] = {}
        self.seconds_compile = 0.0

    def run(
        self,
        particles: Float[np.ndarray, "particles size"],
        key: int | jax.Array,
        *,
        num_last: int = FEWEST_LAST,
        max_stages: int = 200,
        progress: Progress | None = None,
    ) -> Tempered:
        """`num_last` stages move all particles under the target itself.

        SamplingFailed: `max_stages` do not reach it, or it is zero at every particle.
        """
        import blackjax

        key = as_key(key)
        particles, alive = self._path.alive(np.asarray(particles, dtype=float), numpy_random(key))
        state = blackjax.adaptive_tempered_smc.init(jnp.asarray(particles))
        state = state._replace(tempering_param=jnp.zeros(()))  # an array, as in later states: compiled once
        tempering, acceptance, evidence = [0.0], [], float(np.log(alive))
        # A stage moves particles under the b that was reached before: further ones move them under the target.
        while len(acceptance) < len(tempering) + num_last - 1:
            key, now = jax.random.split(key)
            step = {"root": _step_root(state.particles, state.weights)[None]}
            who = "few" if "few" in self._moves and tempering[-1] < 1.0 else "all"
            state, info = self._moved(who, now, state, step)
            acceptance.append(float(info.update_info.acceptance_rate.mean()))
            if progress is not None:
                progress(len(acceptance), max_stages)
            reached = tempering[-1]
            if reached >= 1.0:
                continue
            tempering.append(min(float(state.tempering_param), 1.0))
            evidence += float(info.log_likelihood_increment)
            if len(tempering) > max_stages or not tempering[-1] > reached + LEAST_STEP:
                raise SamplingFailed(
                    f"tempering came to {reached:.3g} of 1 in {len(acceptance)} of {max_stages} stages"
                )
        return Tempered(np.asarray(state.particles), tuple(tempering[1:]), tuple(acceptance), evidence)

    def _moved(self, who: str, *given: Any) -> tuple[Any, Any]:
        """One stage, compiled when it is made first."""
        if who not in self._compiled:
            began, (key, state, step) = time.perf_counter(), given
            num_moves = None if who == "few" else self._num_moves
            self._compiled[who] = self._moves[who].lower(key, state, num_moves, step).compile()
            self.seconds_compile += time.perf_counter() - began
        return self._compiled[who](*given)


def chain_length(count: int) -> int:
    """Particles that each chain leaves: of their divisors up to LONGEST_CHAIN the largest with FEWEST_CHAINS, or 1."""
    return max(n for n in range(1, LONGEST_CHAIN + 1) if count % n == 0 and (n == 1 or count // n >= FEWEST_CHAINS))


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
