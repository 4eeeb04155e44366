"""Importance resampling: an approximate posterior's draws, moved and weighed until they stand for the exact one.

Weights are Pareto-smoothed (Vehtari et al. 2024). Where their tail is too heavy, all draws are moved to the weighted
draws' moments, and weighed anew: moment matching (Paananen et al. 2021, algorithm 1; all draws go along, since the
posterior itself is wanted and no single expectation).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.density import log_prior
from det2stoc_bayes.errors import MethodNotApplicable, SimulationDiverged, listing
from det2stoc_bayes.posterior import DataTree, build
from det2stoc_bayes.psis import effective_draws, resampled, smooth
from det2stoc_bayes.vector_density import AnyDensity

Refine = Literal["none", "psis"]
SURPLUS = 4  # draws of the approximation for each that is wanted, lest one stand for many
MOST_MOVES = 30
ENOUGH = 0.5  # k-hat below which weights have a finite variance: nothing is moved
FEW = 3.0  # effective draws an unknown: of fewer no covariance is told


@dataclass(frozen=True, eq=False)
class Weighed:
    """Draws of a proposal, their log likelihood by recording, and their log density under the proposal.

    The latter may lack a constant.
    """

    z: Float[np.ndarray, "draws size"]
    terms: Float[np.ndarray, "draws recordings"]
    proposal: Float[np.ndarray, " draws"]

    @classmethod
    def of(
        cls, density: AnyDensity, z: Float[np.ndarray, "draws size"], proposal: Float[np.ndarray, " draws"]
    ) -> "Weighed":
        """Draws weighed by the exact likelihood; SimulationDiverged where no simulation of one stays finite."""
        terms = density.log_likelihood_by_recording(z)
        if not np.isfinite(terms).all(1).any():
            raise SimulationDiverged(
                f"of {len(z)} draws of the approximation not one can be simulated; allowed: another method, as smc"
            )
        return cls(z, terms, proposal)

    @property
    def log_weight(self) -> Float[np.ndarray, " draws"]:
        """log target - log proposal."""
        return self.terms.sum(1) + log_prior(self.z) - self.proposal

    @cached_property
    def _smoothed(self) -> tuple[Float[np.ndarray, " draws"], float]:
        return smooth(self.log_weight)

    @cached_property
    def weights(self) -> Float[np.ndarray, " draws"]:
        """Smoothed weights, whose sum is 1."""
        return np.exp(self._smoothed[0])

    @property
    def k_hat(self) -> float:
        """Shape of the weights' tail."""
        return self._smoothed[1]

    @property
    def effective(self) -> float:
        """How many draws of equal weight these are worth."""
        return effective_draws(self.weights)

    def beats(self, other: "Weighed") -> bool:
        """A lighter tail, or where neither is heavy, more effective draws."""
        if max(self.k_hat, other.k_hat) <= ENOUGH:
            return self.effective > other.effective
        return self.k_hat < other.k_hat

    def moved(
        self, density: AnyDensity, stretch: Float[np.ndarray, "size size"], to: Float[np.ndarray, " size"]
    ) -> "Weighed | None":
        """The draws stretched about their mean, which goes to `to`, with the proposal's density.

        None where none can be simulated there.
        """
        z = to + (self.z - self.z.mean(0)) @ stretch.T
        try:
            return self.of(density, z, self.proposal - np.linalg.slogdet(stretch)[1])
        except SimulationDiverged:
            return None


def num_proposed(num_samples: int, refine: Refine) -> int:
    """Draws to take of the proposal; a MethodNotApplicable lists what `refine` may be."""
    if refine not in get_args(Refine):
        raise MethodNotApplicable(f"refine: found {refine!r}; allowed: {listing(get_args(Refine))}")
    return num_samples * (SURPLUS if refine == "psis" else 1)


def build_weighed(
    density: AnyDensity,
    drawn: Weighed,
    num_chains: int,
    refine: Refine,
    random: np.random.Generator,
    *,
    sample_stats: Mapping[str, Any],
    **told: Any,
) -> DataTree:
    """The DataTree of an approximation's draws with their weights, or of what refinement makes of them.

    Attributes of the latter: k_hat and effective_draws of the num_weighed weights that it resampled by, and in `moves`
    how often all draws were moved; its statistics are only those that belong to no draw.
    """
    if refine == "none":
        z, terms = drawn.z.reshape(num_chains, -1, density.size), _by_chain(drawn.terms, num_chains)
        stats = {"log_weight": drawn.log_weight.reshape(num_chains, -1), **sample_stats}
        return build(density, z, sample_stats=stats, log_likelihood=terms, **told)
    drawn, moves = matched(density, drawn)
    rows = resampled(drawn.weights, len(drawn.z) // SURPLUS, random)
    stats = {name: value for name, value in sample_stats.items() if isinstance(value, tuple)}
    z, terms = _by_chain(drawn.z[rows], num_chains), _by_chain(drawn.terms[rows], num_chains)
    tree = build(density, z, sample_stats=stats, log_likelihood=terms, **told)
    tree.attrs |= {
        "k_hat": drawn.k_hat,
        "effective_draws": drawn.effective,
        "num_weighed": len(drawn.z),
        "moves": moves,
    }
    return tree


def matched(density: AnyDensity, drawn: Weighed) -> tuple[Weighed, int]:
    """The draws moved as often as that makes their weights better, and how often.

    Each of up to three moves that are tried simulates every draw once.
    """
    for moves in range(MOST_MOVES):
        enough = drawn.k_hat <= ENOUGH and drawn.effective >= len(drawn.z) / SURPLUS
        better = None if enough else next((m for m in _moves(density, drawn) if m and m.beats(drawn)), None)
        if better is None:
            return drawn, moves
        drawn = better
    return drawn, MOST_MOVES


def _moves(density: AnyDensity, drawn: Weighed) -> Iterator[Weighed | None]:
    """The draws with the weighted ones' mean; with their variances, too; with their covariance."""
    weights, size = drawn.weights, density.size
    to = weights @ drawn.z
    yield drawn.moved(density, np.eye(size), to)
    off = drawn.z - to
    variances = weights @ off**2
    if (variances > 0).all():
        yield drawn.moved(density, np.diag(np.sqrt(variances / drawn.z.var(0))), to)
    if size > 1 and drawn.effective > FEW * size:
        wanted, now = (np.linalg.cholesky(c) for c in ((off.T * weights) @ off, np.cov(drawn.z.T, bias=True)))
        yield drawn.moved(density, wanted @ np.linalg.inv(now), to)


def _by_chain(rows: Float[np.ndarray, "draws _"], num_chains: int) -> Float[np.ndarray, "chain draw _"]:
    return rows.reshape(num_chains, -1, rows.shape[-1])
