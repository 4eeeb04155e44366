"""Recordings that all begin at one known state, each under a psi of its own, and are seen in a window after it.

A population (mu, sigma of each psi) and the recordings' own psi are unknown, as in a study where psi varies by
recording. The likelihood is that of simulations under psi of the prior: their smooth response to psi and, beside the
measurement noise, how they scatter about it, for where bodies touch a step turns on last digits.
"""

from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr, ndtri

from det2stoc_bayes.models._population import Normals
from det2stoc_bayes.models._response import DEGREE, LEAST_MOVED, Response
from det2stoc_bayes.priors import Prior
from det2stoc_bayes.quantiles import library, tail_masses
from det2stoc_bayes.study import Parameter
from det2stoc_bayes.unknowns import Block, Unknowns, lay_out
from det2stoc_bayes.vector_problem import VectorProblem

SEED = 1  # of the recordings, and of the simulations that the likelihood is made of
LEAST_SPREAD = 0.01  # prior sds: sigma where the search for the mode begins, at least


class Windowed(VectorProblem):
    """A scene as such a problem: what is declared, and what a window shows of a simulation."""

    parameters: ClassVar[tuple[Parameter, ...]]  # all vary by recording, with a prior truncated to a box
    reality: ClassVar[Normals]  # that the problem's own recordings are of
    noise: ClassVar[Float[np.ndarray, " features"]]  # sd of what a window shows
    recordings = tuple(f"run_{k + 1:02d}" for k in range(10))
    num_simulated = 8192

    @abstractmethod
    def seen(self, psi: Float[np.ndarray, "sims psi"]) -> Float[np.ndarray, "sims features"]:
        """What a window shows of simulations, without noise."""

    @cached_property
    def unknowns(self) -> Unknowns:
        """mu, sigma and each recording's own value, psi by psi."""
        return lay_out(self.parameters, self.recordings, None)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.unknowns.size

    @property
    def names(self) -> tuple[str, ...]:
        """`wind_mu`, `wind_sigma`, `wind[run_01]` ..."""
        return self.unknowns.names

    @cached_property
    def truth(self) -> Float[np.ndarray, "recordings psi"]:
        """psi of the problem's own recordings."""
        return self.reality.draw(np.random.default_rng([SEED, 0]), len(self.recordings))

    @cached_property
    def observed(self) -> Float[np.ndarray, " features"]:
        """What their windows show, one after the other."""
        seen = self.seen(self.truth)
        return (seen + self.noise * np.random.default_rng([SEED, 1]).standard_normal(seen.shape)).ravel()

    @cached_property
    def response(self) -> Response:
        """Of simulations under psi of the prior."""
        psi = self._simulated
        return Response.of(psi, self.seen(psi), self.noise, (np.array(self._prior.low), np.array(self._prior.high)))

    def prepare(self) -> None:
        """The response, which processes that this is sent to then have."""
        _ = self.response

    def constrained(self, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points size"]:
        """Each unknown in its own unit."""
        return np.stack(list(self.unknowns.constrained(z).values()), 1)

    def simulate(
        self, theta: Float[np.ndarray, "sims size"], random: np.random.Generator
    ) -> Float[np.ndarray, "sims features"]:
        """Windows of all recordings, simulated anew."""
        psi = self._own(theta)
        seen = self.seen(psi.reshape(-1, psi.shape[-1]))
        return (seen + self.noise * random.standard_normal(seen.shape)).reshape(len(theta), -1)

    def by_recording(
        self, theta: Float[np.ndarray, "points size"], x: Float[np.ndarray, " features"]
    ) -> Float[np.ndarray, "points recordings"]:
        """log p(window | the recording's psi)."""
        psi, there = self._own(theta), self.response.components(x.reshape(len(self.recordings), -1))
        terms = self.response.log_density(psi.reshape(-1, psi.shape[-1]), np.tile(there, (len(theta), 1)))
        return terms.reshape(len(theta), len(self.recordings))

    def log_likelihood(
        self, theta: Float[np.ndarray, "points size"], x: Float[np.ndarray, " features"]
    ) -> Float[np.ndarray, " points"]:
        """Their sum."""
        return self.by_recording(theta, x).sum(1)

    def placed(self, w: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points size"]:
        """theta at w: its own psi are quantiles of psi's prior, whatever the population.

        A recording tells its psi far better than the population does: about that, values cling to mu and sigma.
        """
        theta = np.empty(w.shape)
        for b, spread in zip(self.unknowns.blocks, self._spreads, strict=True):
            theta[:, b.begin], theta[:, b.begin + 1] = b.population(w), spread.from_normal(w[:, b.begin + 1])
            theta[:, b.first_own : b.stop] = b.parameter.prior.from_normal(w[:, b.first_own : b.stop])
        return theta

    def outward(self, w: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points size"]:
        """Own psi as quantiles of their population."""
        z, theta = w.copy(), self.placed(w)
        for b in self.unknowns.blocks:
            mu, sigma, own = _split(b, theta)
            below, above, mass = _tails(b, mu, sigma)
            u = (own - mu) / sigma
            low, high = ndtri((ndtr(u) - below) / mass), -ndtri((ndtr(-u) - above) / mass)
            z[:, b.first_own : b.stop] = np.where(u < 0, low, high)
        return z

    def volume(self, theta: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points recordings"]:
        """log density of each recording's psi under the population less that under psi's prior."""
        out = np.zeros((len(theta), len(self.recordings)))
        for b in self.unknowns.blocks:
            mu, sigma, own = _split(b, theta)
            given = b.parameter.prior.arguments
            out += _log_density(b, own, mu, sigma) - _log_density(b, own, given["loc"], given["scale"])
        return out

    def first_guess(self, x: Float[np.ndarray, " features"]) -> Float[np.ndarray, " size"]:
        """Each recording at the likeliest of many psi of the prior, the population at their mean and spread."""
        there = self.response.components(x.reshape(len(self.recordings), -1))
        psi = self._simulated
        off = ((there[:, None] - self.response.predicted(psi)) ** 2).sum(-1)
        near, w = psi[off.argmin(1)], np.empty(self.size)
        for b, own in zip(self.unknowns.blocks, near.T, strict=True):
            prior = b.parameter.prior
            w[b.first_own : b.stop] = prior.to_normal(own)
            w[b.begin] = float(prior.to_normal(own.mean()))
            w[b.begin + 1] = float(b.sigma_prior.to_normal(max(own.std(ddof=1), LEAST_SPREAD * prior.sd)))
        return w

    def probes(self) -> Sequence[Int[np.ndarray, " moved"]]:
        """mu and sigma one by one, all recordings' values of one psi at once."""
        shared = [np.array([j]) for b in self.unknowns.blocks for j in (b.begin, b.begin + 1)]
        return [*shared, *self.unknowns.own]

    @property
    def settings(self) -> tuple[object, ...]:
        """What the likelihood follows from, besides the scene."""
        return (SEED, self.num_simulated, DEGREE, LEAST_MOVED)

    @cached_property
    def _spreads(self) -> tuple[Prior, ...]:
        """Of each sigma; kept, as a prior's sd takes scipy a millisecond."""
        return tuple(b.sigma_prior for b in self.unknowns.blocks)

    @property
    def _simulated(self) -> Float[np.ndarray, "sims psi"]:
        return self._prior.draw(np.random.default_rng([SEED, 2]), self.num_simulated)

    @cached_property
    def _prior(self) -> Normals:
        given = [p.prior.arguments for p in self.parameters]
        loc, scale, low, high = (tuple(g[a] for g in given) for a in ("loc", "scale", "low", "high"))
        return Normals(loc, scale, low, high)

    def _own(self, theta: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points recordings psi"]:
        return np.stack([theta[:, b.first_own : b.stop] for b in self.unknowns.blocks], -1)


type Column = Float[np.ndarray, "points 1"]
type Own = Float[np.ndarray, "points recordings"]


def _split(block: Block, theta: Float[np.ndarray, "points size"]) -> tuple[Column, Column, Own]:
    """mu, sigma and the recordings' values of one psi."""
    return theta[:, [block.begin]], theta[:, [block.begin + 1]], theta[:, block.first_own : block.stop]


def _tails(block: Block, loc: Column | float, scale: Column | float) -> tuple[Any, Any, Any]:
    """What a normal has below the box, above it and within."""
    low, high = block.parameter.prior.support
    return tail_masses((low - loc) / scale, (high - loc) / scale, library(np))


def _log_density(block: Block, values: Own, loc: Column | float, scale: Column | float) -> Own:
    """log density of a normal truncated to the box, up to a constant."""
    return -0.5 * ((values - loc) / scale) ** 2 - np.log(scale * _tails(block, loc, scale)[2])
