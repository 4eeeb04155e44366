"""How well models tell a scene's test set, and how well it could be told: the simulator itself as an oracle."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from det2stoc_bayes import metrics
from det2stoc_bayes.inference._predictive import row_scores
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models._runs import Runs
from det2stoc_bayes.reproduce.scene import Report, Scene
from det2stoc_bayes.transitions import Transitions

NEIGHBOURS = 400  # simulated episodes that tell psi from a state
RIDGE = 1e-3  # of inputs of variance 1
ROLLOUT_STEPS = (10, 50, 100)  # at which rollouts are scored
FOLLOWED = 1500  # rollouts of an experiment whose episodes begin and are commanded differently


def transition_scores(
    simulator: StochasticSimulator,
    test: Transitions,
    num_draws: int,
    key: PRNGKeyArray,
    blocks: Mapping[str, slice] = {},
) -> dict[str, float]:
    """The three log densities of the test set, the first of blocks of the state, and two scores of the draws."""
    scores, ranks = row_scores(simulator, test, num_draws, key, blocks=blocks)
    distances = [metrics.uniform_distance(r) for r in ranks.T]
    return {n: float(v.mean()) for n, v in scores.items()} | {"pit_distance": float(np.mean(distances))}


def rollout_scores(
    rolled: Float[np.ndarray, "draws starts samples s"], true: Float[np.ndarray, "episodes samples s"]
) -> dict[str, float]:
    """Energy score and PIT distance of rollouts from the initial states, or from the one; mean over ROLLOUT_STEPS."""
    energies, distances, unit = [], [], true.std((0, 1))
    for k in ROLLOUT_STEPS:
        draws = np.repeat(rolled[:, :, k] / unit, len(true) // rolled.shape[1], 1)
        energies.append(metrics.energy_score(draws, true[:, k] / unit).mean())
        distances += [metrics.uniform_distance(r) for r in metrics.pit(draws, true[:, k] / unit).T]
    return {"rollout_energy": float(np.mean(energies)), "rollout_pit_distance": float(np.mean(distances))}


def rolled_out(
    simulator: StochasticSimulator, scene: Scene, tested: Runs, num_draws: int, key: PRNGKeyArray
) -> Float[np.ndarray, "draws starts samples s"]:
    """Rollouts from test episodes' first states under their commands, each with a latent that stays."""
    shown = tested[:1] if scene.one_start else tested
    count = num_draws if scene.one_start else max(FOLLOWED // len(tested), 2)
    start, actions = (np.repeat(a, count, 0) for a in (shown.states[:, 0], shown.actions))
    found = simulator.rollout(key, start, actions)
    return np.moveaxis(found.reshape(len(shown), count, *found.shape[1:]), 0, 1)


def population_oracle(
    scene: Scene, test: Runs, psi: Float[np.ndarray, "draws psi"], progress: Report
) -> dict[str, float]:
    """Matched log density where the simulator is asked from each test state, with psi from its true population."""
    return _asked(scene, test, lambda k: np.tile(psi[k], (len(test.transitions), 1)), len(psi), progress)


def known_oracle(
    scene: Scene, test: Runs, psi: Float[np.ndarray, "episodes psi"], progress: Report
) -> dict[str, float]:
    """The same with each episode's own psi: noise alone is left."""
    return _asked(scene, test, lambda _: np.repeat(psi, scene.num_steps, 0), 1, progress)


def state_oracle(
    scene: Scene,
    test: Runs,
    psi: Float[np.ndarray, "episodes psi"],
    states: Float[np.ndarray, "episodes samples s"],
    num_draws: int,
    random: np.random.Generator,
    progress: Report,
) -> dict[str, float]:
    """The same with psi from p(psi | state), which a local regression on simulated episodes tells."""
    rows, size = test.transitions, psi.shape[1]
    steps = np.arange(len(rows)) % scene.num_steps
    mean, factor = np.empty((len(rows), size)), np.empty((len(rows), size, size))
    for k in range(scene.num_steps):
        now = np.flatnonzero(steps == k)
        mean[now], factor[now] = betrayed(rows.state[now], states[:, k], psi)

    def drawn(_: int) -> Float[np.ndarray, "rows psi"]:
        z = random.standard_normal((len(rows), size))
        return np.maximum(mean + np.einsum("rij,rj->ri", factor, z), scene.least)

    return _asked(scene, test, drawn, num_draws, progress)


def betrayed(
    asked: Float[np.ndarray, "rows s"], states: Float[np.ndarray, "episodes s"], psi: Float[np.ndarray, "episodes psi"]
) -> tuple[Float[np.ndarray, "rows psi"], Float[np.ndarray, "rows psi psi"]]:
    """Mean and Cholesky factor of psi given a state, from the nearest simulated episodes at the same time."""
    spread = states.std(0)
    moving = spread > 1e-9
    mean, factor = np.empty((len(asked), psi.shape[1])), np.empty((len(asked), *2 * psi.shape[1:]))
    centre, unit = states.mean(0)[moving], spread[moving]
    x, there = (states[:, moving] - centre) / unit, (asked[:, moving] - centre) / unit
    for i, own in enumerate(there):
        near = np.argsort(((x - own) ** 2).sum(1))[:NEIGHBOURS] if moving.any() else np.arange(len(x))
        inputs = np.concatenate([x[near] - own, np.ones((len(near), 1))], 1)
        penalty = RIDGE * len(near) * np.diag(np.append(np.ones(inputs.shape[1] - 1), 0.0))
        gain = np.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ psi[near])
        mean[i] = gain[-1]
        covariance = np.cov((psi[near] - inputs @ gain).T)
        factor[i] = np.linalg.cholesky(covariance + 1e-12 * np.eye(psi.shape[1]))
    return mean, factor


def _asked(
    scene: Scene,
    test: Runs,
    psi: Callable[[int], Float[np.ndarray, "rows psi"]],
    num_draws: int,
    progress: Report,
) -> dict[str, float]:
    """Of all numbers of the state (`all`), and of its blocks."""
    true = test.transitions.change
    total, squares = np.zeros_like(true), np.zeros_like(true)
    for k in range(num_draws):
        off = scene.change(test, psi(k)) - true
        total, squares = total + off, squares + off**2
        progress(k + 1, num_draws)
    mean = total / num_draws
    spread = np.maximum(squares / num_draws - mean**2, 0.0)
    sd = np.sqrt(spread + scene.noise_variance(test.transitions.state))
    parts = {"all": slice(None), **scene.blocks}
    return {name: float(metrics.gaussian_log_density(mean[:, p], sd[:, p]).mean()) for name, p in parts.items()}
