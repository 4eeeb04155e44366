"""What the methods share: keys, the start from the mode, chains that advance together."""

import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import Density
from det2stoc_bayes.density_jax import HasGradient, Remembered, Terms, count, jax_terms
from det2stoc_bayes.errors import MethodNotApplicable, listing
from det2stoc_bayes.map import Expansion, expand, find_map, find_mode
from det2stoc_bayes.populations import freed
from det2stoc_bayes.posterior import Cost, Progress
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.vector_density import AnyDensity, Inferred, VectorDensity, find_peak
from det2stoc_bayes.vector_problem import Posed

type Mode = Expansion | VectorDensity
Gradient = Literal["auto", "expansion", "finite"]
NUM_CHAINS = 4  # of independent draws, so that every method's result has the same shape
OF_VECTORS = ("blackjax_nuts", "emcee", "laplace", "npe", "nuts", "prior", "smc", "svi")  # methods that need no study
NUM_CHECKED = 4  # points where the expansion's gradient is compared with finite differences
TOLERATED = 0.2  # rms error of a gradient in u, whose typical size is 1


def as_key(key: int | jax.Array) -> jax.Array:
    """A jax key from a seed, a key, or a key of the older kind."""
    if isinstance(key, int):
        return jax.random.key(key)
    return key if jax.numpy.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)


def seed_of(key: jax.Array) -> int:
    """The key as one number (of 64 bits, signed: what files hold)."""
    data = np.asarray(jax.random.key_data(key)).astype(np.uint64).ravel()
    return int((data[-2] << np.uint64(32) | data[-1]).astype(np.int64))


def numpy_random(key: jax.Array) -> np.random.Generator:
    """A numpy generator that follows from the key."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())


def posterior_of(problem: Inferred) -> AnyDensity:
    """A problem's density, in whatever coordinates suit it."""
    return find_peak(problem) if isinstance(problem, Posed) else density_of(problem)


def density_of(problem: Problem) -> Density:
    """A study's density, the MAP's initial states integrated out; spreads of psi that varies are unknowns."""
    found = find_map(problem)
    return Density.at(freed(found) if problem.unknowns.varying else found)


def mode_of(problem: Inferred) -> Mode:
    """The mode of a problem's density, and its shape there."""
    if isinstance(problem, Posed):
        return find_peak(problem)
    return mode_at(density_of(problem))


def mode_at(density: Density) -> Expansion:
    """The density's maximum and its shape there.

    Where psi varies by recording the joint maximum is no place to start (a wide population of equal values): the
    point where sigma's marginal is highest, at which such a density is frozen, is taken.
    """
    if density.problem.unknowns.varying:
        return expand(density, density.center, density.scale)
    return find_mode(density)


def normal_draws(mode: Mode, random: np.random.Generator, *shape: int) -> Float[np.ndarray, "*shape size"]:
    """Draws of the Gaussian at the mode."""
    return mode.center + random.standard_normal((*shape, mode.density.size)) @ mode.scale.T


def per_chain(num_samples: int, num_chains: int) -> int:
    """Draws a chain so that there are `num_samples` in all."""
    return -(-num_samples // num_chains)


def of_study(problem: Inferred, method: str, why: str) -> Problem:
    """A study's problem; MethodNotApplicable for one of vectors, which lacks what `why` says."""
    if isinstance(problem, Posed):
        raise MethodNotApplicable(f"{method}: {problem.name} {why}; allowed: {listing(OF_VECTORS)}")
    return problem


class Target:
    """A density for gradient-based samplers, each point simulated once.

    `gradient`: "finite" differences cost 2 size more simulations a step than the mode's "expansion", whose
    gradients are approximate (the draws are exact with either, see `Expansion`); "auto" takes the expansion
    where it is good. MJX has exact gradients and ignores the choice.
    """

    def __init__(self, mode: Mode, random: np.random.Generator, gradient: Gradient = "auto"):
        density = mode.density
        jax.config.update("jax_enable_x64", True)
        self.density, self.exact = density, density.problem.engine == "mjx"
        if self.exact:
            self.gradient, self._remembered = "forward", None
            self.terms: Terms = jax_terms(density)
            return
        self.gradient = _choose(mode, random) if gradient == "auto" else gradient
        source: HasGradient = mode if self.gradient == "expansion" else density
        self._remembered = Remembered(source, density)
        self.terms = jax_terms(density, self._remembered)

    def by_recording(self, z: Float[np.ndarray, "chain draw size"]) -> Float[np.ndarray, "chain draw recordings"]:
        """log likelihood of draws, most of which were simulated before."""
        flat = z.reshape(-1, z.shape[-1])
        terms = (self._remembered.values if self._remembered else self.density.log_likelihood_by_recording)(flat)
        return terms.reshape(*z.shape[:2], -1)

    def book(self, num_gradients: int) -> None:
        """Count gradients that were taken inside of jax."""
        if isinstance(self.density, Density):
            count(self.density, num_gradients)


def _choose(mode: Mode, random: np.random.Generator) -> Gradient:
    z = normal_draws(mode, random, NUM_CHECKED)
    values, approximate = mode.terms_and_grad(z)
    _, finite = mode.density.terms_and_grad(z)
    error = (approximate - finite) @ mode.scale
    good = np.isfinite(values).all() and np.sqrt((error**2).mean()) < TOLERATED
    return "expansion" if good else "finite"


def advance(
    step: Callable[[Any], Any], state: Any, num_steps: int, cost: Cost, progress: Progress | None
) -> tuple[Any, list[Any]]:
    """A state and what each of `num_steps` steps reports; `step(state) -> (state, report)`."""
    begun = time.perf_counter()
    compiled = jax.jit(step).lower(state).compile()
    cost.seconds_compile += time.perf_counter() - begun
    reports = []
    for i in range(num_steps):
        state, report = compiled(state)
        reports.append(jax.device_get(report))
        if progress is not None:
            progress(i + 1, num_steps)
    return state, reports


def stacked(reports: list[Any]) -> Any:
    """Reports of successive steps (chain, ...) as arrays (chain, draw, ...)."""
    return jax.tree.map(lambda *leaves: np.stack(leaves, 1), *reports)
