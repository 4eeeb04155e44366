"""How well Windy Slope's models tell the test set, and how well it could be told: the simulator itself as an oracle."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from det2stoc_bayes import metrics
from det2stoc_bayes.inference._predictive import row_scores
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models import windy_slope
from det2stoc_bayes.transitions import Transitions

NEIGHBOURS = 400  # simulated episodes that tell psi from a state
RIDGE = 1e-3  # of inputs of variance 1
ROLLOUT_STEPS = (10, 50, 100)  # at which rollouts are scored

Simulate = Callable[..., Float[np.ndarray, "episodes samples 18"]]


def transition_scores(
    simulator: StochasticSimulator, test: Transitions, num_draws: int, key: PRNGKeyArray
) -> dict[str, float]:
    """The three log densities of the test set, and two scores of the draws."""
    scores, ranks = row_scores(simulator, test, num_draws, key)
    distances = [metrics.uniform_distance(r) for r in ranks.T]
    return {n: float(v.mean()) for n, v in scores.items()} | {"pit_distance": float(np.mean(distances))}


def rollout_scores(
    rolled: Float[np.ndarray, "draws samples 18"], true: Float[np.ndarray, "episodes samples 18"]
) -> dict[str, float]:
    """Energy score and PIT distance of rollouts from the initial state, mean over ROLLOUT_STEPS."""
    energies, distances, unit = [], [], true.std((0, 1))
    for k in ROLLOUT_STEPS:
        draws = np.repeat(rolled[:, None, k] / unit, len(true), 1)
        energies.append(metrics.energy_score(draws, true[:, k] / unit).mean())
        distances += [metrics.uniform_distance(r) for r in metrics.pit(draws, true[:, k] / unit).T]
    return {"rollout_energy": float(np.mean(energies)), "rollout_pit_distance": float(np.mean(distances))}


def rolled_out(
    simulator: StochasticSimulator, start: Float[np.ndarray, " 18"], num_draws: int, key: PRNGKeyArray
) -> Float[np.ndarray, "draws samples 18"]:
    """Rollouts from one state, each with a latent that stays."""
    actions = np.zeros((num_draws, windy_slope.NUM_STEPS, 0))
    return simulator.rollout(key, np.tile(start, (num_draws, 1)), actions)


def population_oracle(
    test: Transitions, psi: Float[np.ndarray, "draws 3"], simulate: Simulate, progress: Callable[[int, int], None]
) -> float:
    """Matched log density where the simulator is asked from each test state, with psi from its true population."""
    return _asked(test, lambda k: np.tile(psi[k], (len(test), 1)), len(psi), simulate, progress)


def state_oracle(
    test: Transitions,
    psi: Float[np.ndarray, "episodes 3"],
    states: Float[np.ndarray, "episodes samples 18"],
    num_draws: int,
    random: np.random.Generator,
    simulate: Simulate,
    progress: Callable[[int, int], None],
) -> float:
    """The same with psi from p(psi | state), which a local regression on simulated episodes tells."""
    steps = np.arange(len(test)) % windy_slope.NUM_STEPS
    mean, factor = np.empty((len(test), 3)), np.empty((len(test), 3, 3))
    for k in range(windy_slope.NUM_STEPS):
        rows = np.flatnonzero(steps == k)
        mean[rows], factor[rows] = betrayed(test.state[rows], states[:, k], psi)

    def drawn(_: int) -> Float[np.ndarray, "rows 3"]:
        z = random.standard_normal((len(test), 3))
        found = mean + np.einsum("rij,rj->ri", factor, z)
        found[:, 0] = np.maximum(found[:, 0], windy_slope.LEAST_FRICTION)
        return found

    return _asked(test, drawn, num_draws, simulate, progress)


def betrayed(
    asked: Float[np.ndarray, "rows 18"], states: Float[np.ndarray, "episodes 18"], psi: Float[np.ndarray, "episodes 3"]
) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows 3 3"]]:
    """Mean and Cholesky factor of psi given a state, from the nearest simulated episodes at the same time."""
    spread = states.std(0)
    moving = spread > 1e-9
    mean, factor = np.empty((len(asked), 3)), np.empty((len(asked), 3, 3))
    centre, unit = states.mean(0)[moving], spread[moving]
    x, there = (states[:, moving] - centre) / unit, (asked[:, moving] - centre) / unit
    for i, own in enumerate(there):
        near = np.argsort(((x - own) ** 2).sum(1))[:NEIGHBOURS] if moving.any() else np.arange(len(x))
        inputs = np.concatenate([x[near] - own, np.ones((len(near), 1))], 1)
        penalty = RIDGE * len(near) * np.diag(np.append(np.ones(inputs.shape[1] - 1), 0.0))
        gain = np.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ psi[near])
        mean[i] = gain[-1]
        covariance = np.cov((psi[near] - inputs @ gain).T)
        factor[i] = np.linalg.cholesky(covariance + 1e-12 * np.eye(3))
    return mean, factor


def _asked(
    test: Transitions,
    psi: Callable[[int], Float[np.ndarray, "rows 3"]],
    num_draws: int,
    simulate: Simulate,
    progress: Callable[[int, int], None],
) -> float:
    start = windy_slope.full_state(test.state)
    total, squares = np.zeros_like(test.change), np.zeros_like(test.change)
    for k in range(num_draws):
        off = np.diff(simulate(psi(k), num_steps=1, start=start), axis=1)[:, 0] - test.change
        total, squares = total + off, squares + off**2
        progress(k + 1, num_draws)
    mean = total / num_draws
    sd = np.sqrt(np.maximum(squares / num_draws - mean**2, 0.0))
    return float(metrics.gaussian_log_density(mean, sd).mean())
