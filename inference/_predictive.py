"""A learned stochastic simulator beside a fit: kept in it, and how well it tells transitions that it did not see."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from det2stoc_bayes import metrics
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.posterior import DataTree
from det2stoc_bayes.study_transitions import StudyTransitions
from det2stoc_bayes.transitions import Transitions

ROWS = 500  # at a time
NUM_DRAWS = 1000
LEAST_SD = 0.1  # of a column's noise: no change that was measured is surer
DENSITIES = ("one_latent", "mixture", "matched")


def row_scores(
    simulator: StochasticSimulator,
    data: Transitions,
    num_draws: int,
    key: PRNGKeyArray,
    floor: float | Float[np.ndarray, " s"] = metrics.FLOOR,
    blocks: Mapping[str, slice] = {},
) -> tuple[dict[str, Float[np.ndarray, " rows"]], Float[np.ndarray, "rows s"]]:
    """Three log densities of each transition and the energy score of its draws; its ranks among them.

    one_latent: log p(y | x, z) of a single z from the prior; mixture: of the mean over z; matched: of the Gaussian
    with the draws' moments, its sds at least the floor; the same of blocks of the state, by name. In raw units [nat];
    the energy score in sds of the changes.
    """
    found: dict[str, list[np.ndarray]] = {n: [] for n in (*DENSITIES, "energy", *blocks)}
    ranks, unit = [], data.change.std(0)
    unit = np.where(unit > 0, unit, 1.0)
    for k, begin in enumerate(range(0, len(data), ROWS)):
        part = data[begin : begin + ROWS]
        draws, terms = simulator.draws(jax.random.fold_in(key, k), part, num_draws)
        found["one_latent"].append(terms[0])
        found["mixture"].append(metrics.mixture_log_density(terms))
        found["matched"].append(metrics.matched_log_density(draws, part.change, floor))
        for name, columns in blocks.items():
            least = np.broadcast_to(floor, unit.shape)[columns]
            found[name].append(metrics.matched_log_density(draws[..., columns], part.change[:, columns], least))
        found["energy"].append(metrics.energy_score(draws / unit, part.change / unit))
        ranks.append(metrics.pit(draws, part.change))
    return {n: np.concatenate(v) for n, v in found.items()}, np.concatenate(ranks)


def heldout_transitions(transitions: StudyTransitions) -> Transitions | None:
    """Those of the study's held-out recordings; None where it has none."""
    holdout = transitions.problem.simulator.study.holdout
    return transitions.recorded(holdout) if holdout else None


def predictions(
    simulator: StochasticSimulator,
    transitions: StudyTransitions,
    heldout: Transitions | None,
    key: PRNGKeyArray,
    num_draws: int = NUM_DRAWS,
) -> dict[str, tuple[tuple[str, ...], Any]]:
    """Log densities of held-out recordings, means over each one's transitions; nothing where there are none."""
    if heldout is None:
        return {}
    names = [r.name for r in transitions.problem.simulator.study.holdout]
    scores, _ = row_scores(simulator, heldout, num_draws, key, LEAST_SD * transitions.problem.noise)
    of = [heldout.episode == r for r in range(len(names))]
    told = {f"log_density_{n}": (("heldout",), np.array([scores[n][rows].mean() for rows in of])) for n in DENSITIES}
    return told | {
        "num_transitions": (("heldout",), np.array([rows.sum() for rows in of])),
        "heldout": (("heldout",), np.array(names)),
    }


def kept(simulator: StochasticSimulator, transitions: StudyTransitions) -> dict[str, tuple[tuple[str, ...], Any]]:
    """A simulator as a group of a fit, with what its states and actions consist of."""
    return {
        "file": (("byte",), np.frombuffer(simulator.to_bytes(), np.uint8)),
        "state": (("s",), np.array(transitions.columns)),
        "action": (("a",), np.array(transitions.inputs, dtype=str)),
        "seconds": ((), transitions.seconds),
    }


def learned(fit: DataTree) -> StochasticSimulator:
    """The simulator that a method kept; a Det2StocError where it has none."""
    try:
        return StochasticSimulator.from_bytes(fit["simulator"].to_dataset()["file"].values.astype(np.uint8).tobytes())
    except (KeyError, ValueError) as error:
        method = fit.attrs.get("method", "no method")
        raise Det2StocError(
            f"a fit by {method} holds no learned simulator that this version reads; allowed: det2stoc, baseline_cvae"
        ) from error
