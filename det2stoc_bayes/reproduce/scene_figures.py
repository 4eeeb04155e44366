"""What a scene's figures show, as plain numbers: recordings, the effect of each psi, densities of next states."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from det2stoc_bayes import metrics
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models._runs import Runs
from det2stoc_bayes.reproduce.scene import Scene

SHOWN_STEPS = (1, 50, 100)  # transitions whose densities are shown
POSES = (0, 50, 100)  # samples at which boxes are drawn
NUM_RECORDINGS = 10
NUM_DRAWS = 2000
NUM_BINS = 60
SWEEP = 5  # values of each psi
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
EDGES = [(i, j) for i in range(8) for j in range(i) if (np.abs(CORNERS[i] - CORNERS[j]) > 0).sum() == 1]


def figures(
    scene: Scene,
    tested: Runs,
    psi: Float[np.ndarray, "episodes psi"],
    simulators: Mapping[str, StochasticSimulator],
    random: np.random.Generator,
) -> dict[str, Any]:
    """All figures' numbers; `simulators` are those of one seed by name."""
    com = psi[:, scene.names.index("com")]
    return {
        "poses": poses(scene, tested.states[:NUM_RECORDINGS], com[:NUM_RECORDINGS]),
        "sweeps": sweeps(scene),
        "densities": [densities(scene, tested, step, simulators, random) for step in SHOWN_STEPS],
    }


def poses(
    scene: Scene, states: Float[np.ndarray, "episodes samples s"], com: Float[np.ndarray, " episodes"]
) -> list[dict[str, Any]]:
    """Outlines of the boxes and of their hidden blocks, as edges in space."""
    out = []
    for k in POSES:
        box, block = zip(*[outlines(scene, one[k], x) for one, x in zip(states, com, strict=True)], strict=True)
        out.append({"sample": k, "box": np.round(box, 3).tolist(), "block": np.round(block, 3).tolist()})
    return out


def outlines(
    scene: Scene, state: Float[np.ndarray, " s"], com: float
) -> tuple[Float[np.ndarray, "edges 2 3"], Float[np.ndarray, "edges 2 3"]]:
    """Edges of the box and of its hidden block."""
    place = state[scene.place : scene.place + 3]
    turn = state[scene.matrix : scene.matrix + 9].reshape(3, 3)
    found = []
    for half, centre in ((scene.box, np.zeros(3)), (scene.block, np.array([com, 0.0, -scene.depth]))):
        corners = place + (centre + CORNERS * half) @ turn.T
        found.append(np.array([[corners[i], corners[j]] for i, j in EDGES]))
    return found[0], found[1]


def sweeps(scene: Scene) -> list[dict[str, Any]]:
    """Positions over time, one psi at a time between psi_0's bounds, the rest at reality's means."""
    out, middle = [], np.array(scene.reality.loc)
    for j, (name, unit) in enumerate(zip(scene.names, scene.units, strict=True)):
        values = np.linspace(scene.prior.low[j], scene.prior.high[j], SWEEP)
        psi = np.tile(middle, (SWEEP, 1))
        psi[:, j] = values
        out.append({"name": name, "unit": unit, "values": values.tolist(), "position": scene.swept(psi).tolist()})
    return out


def densities(
    scene: Scene,
    tested: Runs,
    step: int,
    simulators: Mapping[str, StochasticSimulator],
    random: np.random.Generator,
) -> dict[str, Any]:
    """p(change | state, action) of the first test episode's numbers that are shown, and KL of the moments.

    Under the simulator with reality's psi, and under each model.
    """
    row = tested[:1].transitions[step - 1 : step]
    psi = scene.reality.draw(random, NUM_DRAWS)
    drawn = {"simulator": scene.change(tested[:1], psi, np.full(NUM_DRAWS, step - 1))}
    noise = np.sqrt(scene.noise_variance(row.state))
    if noise.any():
        drawn["simulator"] += noise * random.standard_normal(drawn["simulator"].shape)
    for name, simulator in simulators.items():
        state, action = (np.tile(a, (NUM_DRAWS, 1)) for a in (row.state, row.action))
        drawn[name] = simulator.sample(jax.random.key(step), state, action) - state
    drawn = {name: d[:, scene.shown] for name, d in drawn.items()}
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
