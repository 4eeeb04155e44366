"""What is believed of one hypothesis: draws of its posterior, from a cheap proposal that the exact likelihood corrects.

The target is the one that the fit has: the prior times the likelihood to the power share / s2, which is 1 under the
right model. Proposals are Student-t in coordinates where the posterior is roughly standard normal; the weights are
Pareto-smoothed. Where k-hat says that they fail, coordinates follow a bent valley, the proposal adapts, and at last
particles are tempered.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.special import logsumexp

from det2stoc_bayes.density import Density, log_prior
from det2stoc_bayes.errors import SamplingFailed
from det2stoc_bayes.mismatch.coordinates import Affine, Coordinates, Population
from det2stoc_bayes.mismatch.valley import Valley
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.populations import freed
from det2stoc_bayes.psis import effective_draws, reliable, resampled, smooth, thinned

NUM_DRAWS = 1000
TEMPERING = 60_000  # evaluations that particles take (15 moves a stage)
BUDGET = 0.05  # of all simulation steps so far: what one belief may cost
FEWEST, MOST = 128, 1024  # exact evaluations a round; powers of two, for Sobol's points
DEGREES = 5  # of freedom of the proposal
ENOUGH = 100  # effective draws: the sds of a belief are then known to 7 %
NUM_ROUNDS = 3  # of which the later ones adapt
NUM_PARTICLES = 512
WORST = 10.0  # k-hat of weights that are all on a few draws, which may be infinite
SPARE = 8  # times as many draws of a Gaussian as are kept, so that some are within the walls

LogDensity = Callable[[Float[np.ndarray, "points size"]], Float[np.ndarray, " points"]]
Temper = Callable[[LogDensity, LogDensity, np.ndarray, int], np.ndarray]
"""Particles moved from one density to another, by a seed: `inference.smc.temper`'s."""
Sampler = Callable[[Density, int, Callable[[int, int], None]], Float[np.ndarray, "chain draw size"]]
"""Draws of a density by a seed, progress reported: `inference.nuts`."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Equally weighted draws of a hypothesis' posterior; where psi varies, sigma is among the unknowns."""

    fit: Fit
    density: Density
    z: Float[np.ndarray, "draws size"]
    terms: Float[np.ndarray, "draws recordings"] | None  # tempered log likelihood; None: draws were not weighed
    method: str  # laplace, laplace+psis, adapted, smc or nuts
    k_hat: float | None  # of the importance weights; None: nothing to weigh
    evaluations: int

    def summary(self) -> dict[str, Any]:
        """For diagnosis.json."""
        return {
            "method": self.method,
            "k_hat": None if self.k_hat is None else min(self.k_hat, WORST),
            "draws": len(self.z),
            "evaluations": self.evaluations,
        }


def believe(fit: Fit, share: float, seed: int, *, temper: Temper | None = None, num_draws: int = NUM_DRAWS) -> Belief:
    """The posterior of a hypothesis about its fit; `share` as in `evidence.effective_share`.

    `temper` is called where importance sampling fails; without it the last adapted proposal stands, or where few draws
    count the Gaussian at the fit, and k-hat says so.
    """
    own, density, coordinates = _about(fit, share)
    if density.size == 0:
        terms = np.repeat(density.log_likelihood_by_recording(np.zeros((1, 0))), num_draws, 0)
        return Belief(own, density, np.zeros((num_draws, 0)), terms, "laplace+psis", None, 1)
    drawn = _Weighted(density, coordinates, seed)
    for k in range(NUM_ROUNDS):
        drawn.add(_budget(fit))
        if (trusted := drawn.k_hat < reliable(len(drawn.x))) and drawn.effective >= ENOUGH:
            return drawn.belief(own, "adapted" if k else "laplace+psis", num_draws)
        if not k and (valley := Valley.about(density, coordinates)) is not None:
            drawn = _Weighted(density, valley, seed, spent=len(drawn.x) + valley.evaluations, whole=valley.whole)
    if not trusted and temper is not None:
        try:
            return drawn.tempered(own, temper, num_draws)
        except SamplingFailed:
            pass  # k-hat already says how far the draws can be trusted
    if not trusted and 0 < drawn.effective < ENOUGH:  # a few draws in a bent valley would pass as its width
        rough = roughly(fit, share, seed, num_draws=num_draws)
        return replace(rough, k_hat=drawn.k_hat, evaluations=drawn.evaluations)
    return drawn.belief(own, "adapted", num_draws)


def roughly(fit: Fit, share: float, seed: int, *, num_draws: int = NUM_DRAWS) -> Belief:
    """Draws of Laplace's approximation itself, within the walls of positive parameters.

    For fits that leave a misfit: the widened likelihood is a convention there, and weighing by it adds no truth.
    """
    own, density, coordinates = _about(fit, share)
    normal = np.random.default_rng(seed).standard_normal((SPARE * num_draws, coordinates.size))
    z, floor = coordinates(normal)[0], own.problem.floor
    inside = np.flatnonzero((z >= floor).all(1))
    chosen = np.resize(inside, num_draws) if len(inside) else np.arange(num_draws)
    return Belief(own, density, np.maximum(z[chosen], floor), None, "laplace", None, 0)


def _about(fit: Fit, share: float) -> tuple[Fit, Density, Coordinates]:
    """The fit with its populations' spreads free, its tempered density, and coordinates in which that is normal."""
    power = share / fit.noise_scale
    varies = bool(fit.problem.unknowns.varying) and fit.problem.spreads is not None
    own = freed(fit) if varies else fit
    return own, Density.at(own, power), Population(fit, own.problem.unknowns, power) if varies else Affine(own, power)


def with_chains(cheap: Belief, chains: Float[np.ndarray, "chain draw size"], evaluations: int) -> Belief:
    """The same posterior by Markov chains in place of the cheap draws, as many and evenly thinned."""
    flat = chains.reshape(-1, chains.shape[-1])
    kept = thinned(flat, len(cheap.z))
    terms = cheap.density.log_likelihood_by_recording(kept)
    return Belief(cheap.fit, cheap.density, kept, terms, "nuts", cheap.k_hat, evaluations)


def _budget(fit: Fit) -> int:
    """Evaluations a round, by what the diagnosis has simulated so far (not by time: a seed has one result)."""
    allowed = BUDGET * _evaluations_so_far(fit)
    return int(2 ** np.floor(np.log2(np.clip(allowed, FEWEST, MOST))))


def affordable(fit: Fit) -> bool:
    """Whether tempered particles would cost no more than the diagnosis so far."""
    return _evaluations_so_far(fit) > TEMPERING


def _evaluations_so_far(fit: Fit) -> float:
    """Simulation steps taken, in evaluations of the density."""
    problem, model = fit.problem, fit.problem.simulator.model
    once = problem.segments.count * int(problem.segments.steps(problem.timestep or float(model.opt.timestep)).max())
    return problem.simulator.counter.steps / once


class _Weighted:
    """Points of several proposals, weighted as draws of their mixture.

    `spent`: evaluations before; where the coordinates do not follow the `whole` posterior no k-hat is to be trusted.
    """

    def __init__(
        self, density: Density, coordinates: Coordinates, seed: int, *, spent: int = 0, whole: bool = True
    ) -> None:
        self.density, self.coordinates, self.seed = density, coordinates, seed
        self.spent, self.whole = spent, whole
        self.proposals: list[tuple[np.ndarray, np.ndarray, int]] = []  # centre, root, points
        size = density.size
        self.x, self.z = np.empty((0, size)), np.empty((0, size))
        self.terms, self.log_target = np.empty((0, len(density.problem.segments.recordings))), np.empty(0)
        self.k_hat, self.log_weights = np.inf, np.empty(0)

    def add(self, count: int) -> None:
        """Points of another proposal, fitted to those so far, and everyone's weights anew."""
        center, root = self._fitted() if self.proposals else (np.zeros(self.density.size), np.eye(self.density.size))
        self.proposals.append((center, root, count))
        normal = _student(self.density.size, count, self.seed + len(self.proposals))
        x = center + normal @ root.T
        z, terms, value = self._evaluate(x)
        self.x, self.z = np.concatenate([self.x, x]), np.concatenate([self.z, z])
        self.terms, self.log_target = np.concatenate([self.terms, terms]), np.concatenate([self.log_target, value])
        self.log_weights, k_hat = smooth(self.log_target - self.log_proposal(self.x))
        self.k_hat = k_hat if self.whole else np.inf

    @property
    def evaluations(self) -> int:
        """Of the density."""
        return self.spent + len(self.x)

    @property
    def effective(self) -> float:
        """Draws of equal weight that would tell as much."""
        return effective_draws(np.exp(self.log_weights))

    def _evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """z, tempered log likelihood by recording, and log posterior in x."""
        z, volume = self.coordinates(x)
        terms = self.density.log_likelihood_by_recording(z)
        value = terms.sum(1) + log_prior(z) + volume
        return z, terms, np.where(np.isfinite(value), value, -np.inf)

    def log_proposal(self, x: np.ndarray) -> np.ndarray:
        """log density of the proposals' mixture."""
        total, parts = sum(n for *_, n in self.proposals), []
        for center, root, n in self.proposals:
            u = np.linalg.solve(root, (x - center).T).T
            wide = stats.multivariate_t(np.zeros(x.shape[1]), df=DEGREES)
            parts.append(np.reshape(wide.logpdf(u), len(x)) - np.log(np.diag(root)).sum() + np.log(n / total))
        return np.asarray(logsumexp(parts, axis=0))

    def _fitted(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and root of covariance of the weighted points, blended with the last proposal's where few count."""
        w = np.exp(self.log_weights)
        if not w.sum() > 0:
            return self.proposals[-1][:2]
        mean = w @ self.x / w.sum()
        covariance = (w[:, None] * (self.x - mean)).T @ (self.x - mean) / w.sum()
        effective, size = self.effective, self.density.size
        last = self.proposals[-1][1]
        blended = (effective * covariance + size * last @ last.T) / (effective + size)
        return mean, np.linalg.cholesky(blended)

    def belief(self, fit: Fit, method: str, num_draws: int) -> Belief:
        """Equally weighted draws by systematic resampling."""
        weights = np.exp(self.log_weights)
        if not weights.sum() > 0:
            raise SamplingFailed("no draw about the fit has a finite likelihood")
        chosen = resampled(weights, num_draws, np.random.default_rng(self.seed))
        return Belief(fit, self.density, self.z[chosen], self.terms[chosen], method, self.k_hat, self.evaluations)

    def tempered(self, fit: Fit, temper: Temper, num_draws: int) -> Belief:
        """Particles of the last proposal, tempered to the posterior."""
        count = [self.evaluations]

        def log_target(x):
            count[0] += len(x)
            return self._evaluate(x)[2]

        last = self.proposals[-1]
        self.proposals = [(*last[:2], NUM_PARTICLES)]
        first = last[0] + _student(self.density.size, NUM_PARTICLES, self.seed) @ last[1].T
        x = temper(self.log_proposal, log_target, first, self.seed)
        z, terms, _ = self._evaluate(x)
        chosen = np.random.default_rng(self.seed).permutation(np.resize(np.arange(len(z)), num_draws))
        return Belief(fit, self.density, z[chosen], terms[chosen], "smc", self.k_hat, count[0] + len(x))


def _student(size: int, count: int, seed: int) -> Float[np.ndarray, "count size"]:
    """Points of a multivariate Student-t, more even than chance would have them (scrambled Sobol's)."""
    u = stats.qmc.Sobol(size + 1, rng=np.random.default_rng(seed)).random(count)
    u = np.clip(u, 1e-10, 1 - 1e-10)
    return stats.norm.ppf(u[:, :-1]) * np.sqrt(DEGREES / stats.chi2.ppf(u[:, -1:], DEGREES))
