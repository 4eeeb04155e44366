"""What Windy Slope's figures show, as plain numbers: recordings, the effect of each psi, densities of next states."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from det2stoc_bayes import metrics
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models import windy_slope

SHOWN_STEPS = (1, 50, 100)  # transitions whose densities are shown
POSES = (0, 50, 100)  # samples at which boxes are drawn
NUM_RECORDINGS = 10
NUM_DRAWS = 2000
NUM_BINS = 60
SWEEP = 5  # values of each psi
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
EDGES = [(i, j) for i in range(8) for j in range(i) if (np.abs(CORNERS[i] - CORNERS[j]) > 0).sum() == 1]
BOX, BLOCK = (0.5, 0.5, 0.5), (0.25, 0.5, 0.25)  # half-sizes


def figures(
    tested: Float[np.ndarray, "episodes samples 18"],
    psi: Float[np.ndarray, "episodes 3"],
    simulators: Mapping[str, StochasticSimulator],
    random: np.random.Generator,
) -> dict[str, Any]:
    """All figures' numbers; `simulators` are those of one seed by name."""
    return {
        "poses": poses(tested[:NUM_RECORDINGS], psi[:NUM_RECORDINGS, 1]),
        "sweeps": sweeps(),
        "densities": [densities(tested[0], step, simulators, random) for step in SHOWN_STEPS],
    }


def poses(
    states: Float[np.ndarray, "episodes samples 18"], com: Float[np.ndarray, " episodes"]
) -> list[dict[str, Any]]:
    """Outlines of the boxes and of their hidden blocks, as edges in space."""
    out = []
    for k in POSES:
        box, block = zip(*[outlines(one[k], x) for one, x in zip(states, com, strict=True)], strict=True)
        out.append({"sample": k, "box": np.round(box, 3).tolist(), "block": np.round(block, 3).tolist()})
    return out


def outlines(
    state: Float[np.ndarray, " 18"], com: float
) -> tuple[Float[np.ndarray, "edges 2 3"], Float[np.ndarray, "edges 2 3"]]:
    """Edges of the box and of its hidden block."""
    place, turn = state[:3], state[3:12].reshape(3, 3)
    found = []
    for half, centre in ((BOX, np.zeros(3)), (BLOCK, np.array([com, 0.0, -0.25]))):
        corners = place + (centre + CORNERS * half) @ turn.T
        found.append(np.array([[corners[i], corners[j]] for i, j in EDGES]))
    return found[0], found[1]


def sweeps() -> list[dict[str, Any]]:
    """Positions over time, one psi at a time between psi_0's bounds, the rest at reality's means."""
    out, middle = [], np.array(windy_slope.REALITY.loc)
    for j, (name, unit) in enumerate(zip(windy_slope.NAMES, windy_slope.UNITS, strict=True)):
        values = np.linspace(windy_slope.PRIOR.low[j], windy_slope.PRIOR.high[j], SWEEP)
        psi = np.tile(middle, (SWEEP, 1))
        psi[:, j] = values
        states = windy_slope.simulate(psi)
        out.append({"name": name, "unit": unit, "values": values.tolist(), "position": states[..., :3].tolist()})
    return out


def densities(
    episode: Float[np.ndarray, "samples 18"],
    step: int,
    simulators: Mapping[str, StochasticSimulator],
    random: np.random.Generator,
) -> dict[str, Any]:
    """p(change | state) in every dimension under the simulator with reality's psi and under each model, and KL."""
    state = episode[step - 1]
    psi = windy_slope.REALITY.draw(random, NUM_DRAWS)
    start = np.tile(windy_slope.full_state(state[None]), (NUM_DRAWS, 1))
    drawn = {"simulator": np.diff(windy_slope.simulate(psi, num_steps=1, start=start), axis=1)[:, 0]}
    for name, simulator in simulators.items():
        rows = np.tile(state, (NUM_DRAWS, 1))
        drawn[name] = simulator.sample(jax.random.key(step), rows, np.zeros((NUM_DRAWS, 0))) - rows
    true = drawn["simulator"]
    low, high = np.quantile(np.concatenate([true, *drawn.values()]), [0.002, 0.998], axis=0)
    high = np.maximum(high, low + 1e-6)
    moments = {name: (d.mean(0), np.maximum(d.std(0), metrics.FLOOR)) for name, d in drawn.items()}
    edges = np.linspace(low, high, NUM_BINS + 1)
    return {
        "step": step,
        "edges": edges.T.tolist(),
        "heights": {
            name: [np.histogram(d[:, i], edges[:, i], density=True)[0].tolist() for i in range(d.shape[1])]
            for name, d in drawn.items()
        },
        "divergence": {
            name: [
                metrics.gaussian_divergence(*(float(m[i]) for m in (*moments["simulator"], *moments[name])))
                for i in range(true.shape[1])
            ]
            for name in simulators
        },
    }
