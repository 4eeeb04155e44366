"""emcee's ensemble sampler: no gradients; every half of the ensemble is one batch of simulations.

Moves: differential evolution, and independent draws of a wide Student-t at the mode, which reach anywhere at
once where the posterior is near its Gaussian.
"""

from typing import Any, cast

import emcee
import jax
import numpy as np
from jaxtyping import Float
from scipy import stats

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.density_jax import Remembered
from det2stoc_bayes.inference._sampling import Mode, as_key, mode_of, normal_draws, numpy_random, per_chain, seed_of
from det2stoc_bayes.posterior import DataTree, Progress, build, measured
from det2stoc_bayes.vector_density import Inferred

CHECK_EVERY = 25  # steps
BURN_IN = 3.0  # autocorrelation times left out (the walkers start as draws of the mode's Gaussian)
DEGREES = 6  # of freedom of the Student-t
SHARE = 0.6  # of steps that are independent draws


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    num_walkers: int | None = None,
    num_autocorrelation_times: float = 50.0,
    max_steps: int = 10_000,
    progress: Progress | None = None,
) -> DataTree:
    """At least `num_samples` thinned draws; walkers are the chains: judge by autocorrelation time, not R-hat.

    It runs until `num_autocorrelation_times` have passed after the burn-in (`converged`), or `max_steps`.
    """
    options = {
        "num_samples": num_samples,
        "num_walkers": num_walkers,
        "num_autocorrelation_times": num_autocorrelation_times,
        "max_steps": max_steps,
    }
    key = as_key(key)
    with measured(problem) as cost:
        mode, random = mode_of(problem), numpy_random(key)
        density = mode.density
        walkers = num_walkers or max(4 * density.size, 16)
        remembered = Remembered(density, density)

        def log_density(z):
            return remembered.values(z).sum(1) + log_prior(z)

        moves = [(emcee.moves.DEMove(), 1 - SHARE), (emcee.moves.MHMove(_independent(mode)), SHARE)]
        sampler = emcee.EnsembleSampler(walkers, density.size, log_density, vectorize=True, moves=moves)
        cast(Any, sampler).log_prob_fn = log_density  # emcee's wrapper prints a traceback at Ctrl-C
        sampler.random_state = np.random.RandomState(random.integers(2**32 - 1)).get_state()
        draws = per_chain(num_samples, walkers)
        time, converged = _run(
            sampler,
            normal_draws(mode, random, walkers),
            draws,
            num_autocorrelation_times,
            max_steps,
            progress,
        )
        kept, thin = _kept(sampler.iteration, time, draws)
        z = np.swapaxes(np.asarray(sampler.get_chain())[kept], 0, 1)
        sample_stats = {
            "autocorrelation_time": (("unknown",), time),
            "acceptance_rate": (("chain",), sampler.acceptance_fraction),
            "thinned_by": ((), thin),
            "steps": ((), sampler.iteration),
            "converged": ((), converged),
        }
        terms = remembered.values(z.reshape(-1, density.size)).reshape(*z.shape[:2], -1)
        return build(
            mode.density,
            z,
            method="emcee",
            options=options,
            seed=seed_of(key),
            cost=cost,
            sample_stats=sample_stats,
            log_likelihood=terms,
        )


def _independent(mode: Mode):
    wide = stats.multivariate_t(np.zeros(mode.density.size), df=DEGREES)

    def propose(z: Float[np.ndarray, "walkers size"], random: np.random.RandomState):
        u = np.linalg.solve(mode.scale, (z - mode.center).T).T
        new = wide.rvs(size=len(z), random_state=random).reshape(u.shape)
        return mode.center + new @ mode.scale.T, np.ravel(wide.logpdf(u) - wide.logpdf(new))

    return propose


def _run(sampler, first, draws, num_times, max_steps, progress) -> tuple[Float[np.ndarray, " size"], bool]:
    """Autocorrelation times, and whether enough of them have passed."""
    time, check = np.full(first.shape[1], np.inf), CHECK_EVERY
    for _ in sampler.sample(first, iterations=max_steps, store=True):
        if progress is not None:
            progress(sampler.iteration, max_steps)
        if sampler.iteration < check:
            continue
        check += max(CHECK_EVERY, sampler.iteration // 20)  # of a long chain it takes longer than steps do
        time = np.maximum(sampler.get_autocorr_time(tol=0), 1.0)
        if not np.isfinite(time).all():
            continue
        kept = sampler.iteration - BURN_IN * time.max()
        if kept >= max(num_times * time.max(), draws):
            return time, True
    return time, False


def _kept(steps: int, time: np.ndarray, draws: int) -> tuple[np.ndarray, int]:
    """Steps to keep, evenly thinned, after the burn-in."""
    longest = time.max() if np.isfinite(time).all() else steps / 10
    after = max(steps - int(np.ceil(BURN_IN * longest)), min(draws, steps))
    thin = max(after // draws, 1)
    return np.arange(steps - 1, steps - 1 - thin * min(draws, after), -thin)[::-1], thin
