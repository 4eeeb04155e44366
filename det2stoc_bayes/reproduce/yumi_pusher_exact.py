"""Posteriors of YuMi Pusher's recorded episodes by the simulator itself, by SMC, and of the population behind them."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy import stats

from det2stoc_bayes.density import scale_of
from det2stoc_bayes.inference._episodes import population_draws
from det2stoc_bayes.inference.smc import DEGREES, temper
from det2stoc_bayes.models.yumi_pusher import PRIOR
from det2stoc_bayes.models.yumi_pusher_likelihood import mode
from det2stoc_bayes.reproduce.work import Work
from det2stoc_bayes.transitions import Transitions

STARTS = (6, 300)  # that each psi is tried from, and that covariances are found from
QUICK, QUICKLY = 20, (4, 100)  # so few particles have so few starts
TARGET_ESS = 0.7  # share of particles after a stage
NUM_MOVES, NUM_LAST = 1, 1  # of a stage, and stages at the end: from a Student-t at the mode two lead to the posterior
EXACT = 10  # names the randomness


def exact_posteriors(work: Work, number: int) -> dict[str, Any]:
    """What a seed's recorded episodes and their population have, of those that the last iteration learns from."""
    settings = work.settings
    count = work.scene.real_episodes[settings.num_iterations - 1]
    recorded, episodes = cache(partial(work.real, number)), []
    for e in range(count):

        def made(e: int = e) -> dict[str, Any]:
            random = work.random(EXACT, number, e)
            return episode_posterior(recorded()[e : e + 1].transitions, settings.num_particles, random, e)

        work.progress("drawing exact posteriors", number * count + e, settings.num_seeds * count)
        episodes.append(work.kept(f"exact{number}_{e}", made))
    told = {key: [episode[key] for episode in episodes] for key in ("mean", "covariance", "transitions")}
    found = population(np.array(told["mean"]), np.array(told["covariance"]), work, number)
    return {"drawn": work.drawn(number)[:count].tolist(), **told, "population": found}


def episode_posterior(
    recorded: Transitions, num_particles: int, random: np.random.Generator, seed: int
) -> dict[str, Any]:
    """Moments of (friction, com) under psi_0's uniform prior, and how the particles came there."""
    likelihood, summit, precision = mode(recorded, random, *(QUICKLY if num_particles <= QUICK else STARTS))
    scale = scale_of(precision)
    wide = stats.multivariate_t(np.zeros(2), df=DEGREES)
    double = jax.config.jax_enable_x64
    try:
        found = temper(
            lambda u: np.atleast_1d(wide.logpdf(u)),
            lambda u: log_posterior(likelihood, summit + u @ scale.T),
            wide.rvs(num_particles, random_state=random),
            seed,
            target_ess=TARGET_ESS,
            num_moves=NUM_MOVES,
            num_last=NUM_LAST,
        )
    finally:  # SMC leaves double precision on, and networks then draw other numbers
        jax.config.update("jax_enable_x64", double)
    draws = summit + found.particles @ scale.T
    return {
        "mean": draws.mean(0).tolist(),
        "covariance": np.cov(draws.T).tolist(),
        "transitions": len(likelihood.actions),
        "stages": len(found.tempering),
        "acceptance": found.acceptance,
    }


def log_posterior(
    likelihood: Callable[[np.ndarray], np.ndarray], psi: Float[np.ndarray, "points 2"]
) -> Float[np.ndarray, " points"]:
    """Up to a constant; psi_0 ends the range."""
    inside = ((psi >= PRIOR.low) & (psi <= PRIOR.high)).all(1)
    out = np.full(len(psi), -np.inf)
    if inside.any():
        out[inside] = likelihood(psi[inside])
    return out


def population(
    means: Float[np.ndarray, "episodes 2"],
    covariances: Float[np.ndarray, "episodes 2 2"],
    work: Work,
    number: int,
) -> dict[str, Any]:
    """Posterior of the mean and sd that episodes' psi come from, as det2stoc's own: episodes' posteriors are narrow
    beside it, so that their moments serve."""
    low, high = np.array(PRIOR.low), np.array(PRIOR.high)
    loc, unit = (low + high) / 2, (high - low) / np.sqrt(12)
    precision = np.linalg.inv(covariances / np.outer(unit, unit))
    under_normal = np.linalg.inv(precision + np.eye(2))
    centred = np.einsum("eij,ejk,ek->ei", under_normal, precision, (means - loc) / unit)
    centre, spread = population_draws(centred, under_normal, work.key("exact", number))
    centre, spread = loc + unit * centre, unit * spread
    return {
        "mean": centre.mean(0).tolist(),
        "mean_sd": centre.std(0).tolist(),
        "sd": spread.mean(0).tolist(),
        "sd_sd": spread.std(0).tolist(),
    }
