"""The declared likelihood, shared by all methods: given noise, initial states integrated out about the MAP.

log p(y | z) = log normalizer - 1/2 |project(stack(y - prediction(z)))|^2, with starts and projection frozen
at the MAP: every method then has the same target, however it moves. Under noise with heavy tails nothing can be
projected out, and the starts are refitted at each z, by sensitivities from the MAP.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.likelihood import LatentStarts
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.problem import Problem, repeat_start
from det2stoc_bayes.robust_starts import left_over

MAX_VALUES = 16_000_000  # residual numbers held at once
STEP = 0.1  # of a posterior sd: finite difference of a gradient (rounding over long rollouts forbids less)


@dataclass(frozen=True, eq=False)
class Density:
    """Prior N(0, I) and likelihood of the unknowns z of a problem."""

    problem: Problem
    center: Float[np.ndarray, " size"]  # z of the MAP
    scale: Float[np.ndarray, "size size"]  # lower triangular; z = center + scale u makes u about standard normal
    start: Start
    latent: LatentStarts
    offset: Float[np.ndarray, "segments states"]  # guessed starts from the MAP's, in tangent coordinates
    temper: float = 1.0  # power of the likelihood: below 1 where the model's error widens the noise

    @classmethod
    def at(cls, fit: Fit, temper: float = 1.0) -> "Density":
        """Frozen at a fit's starts and linearization; the noise is the problem's, its variance over `temper`."""
        linear, problem = fit.linear, fit.problem
        offset = linear.stacked[:, problem.weight.shape[1] :, 0] * linear.latent.prior_sd
        precision = temper * linear.gram()[0].sum(0) + np.eye(problem.size)
        return cls(problem, fit.point.z, scale_of(precision), fit.point.start, linear.latent, offset, temper)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.problem.size

    @cached_property
    def normalizer(self) -> Float[np.ndarray, " segments"]:
        """The terms of `LatentStarts.log_normalizer`, one a segment, tempered."""
        return self.temper * self.latent.log_normalizers

    @cached_property
    def sensitivity(self) -> Float[np.ndarray, "segments values states"]:
        """Of predictions to the initial states, in noise sds."""
        weight = self.problem.weight
        weighed = self.latent.basis[:, : weight.shape[1]] @ self.latent.triangle
        slope = np.divide(self.latent.weight, weight, out=np.ones_like(weight), where=weight > 0)
        return weighed / slope[..., None]

    def projected(self, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "segments stacked points"]:
        """Whitened residuals that no initial state explains, tempered; NaN where a simulation diverged."""
        problem, points = self.problem, len(z)
        predicted = problem.simulator.rollout(problem.request(z, repeat_start(self.start, points)))
        diverged = ~np.isfinite(predicted).all((1, 2))
        residuals = problem.residuals(predicted)
        residuals[diverged] = np.nan
        columns = np.moveaxis(residuals.reshape(points, problem.segments.count, -1), 0, -1)
        columns = columns * problem.weight[..., None]
        if problem.measurement.degrees_of_freedom is not None:
            left = left_over(columns, self.offset, self.sensitivity, self.latent.prior_sd, problem.measurement)
            return np.sqrt(self.temper) * left
        offset = np.broadcast_to(self.offset[..., None], (*self.offset.shape, points))
        return np.sqrt(self.temper) * self.latent.project(self.latent.stack_whitened(columns, offset))

    def log_likelihood_by_segment(self, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points segments"]:
        """One term a segment; -inf where its simulation diverged, and where a positive parameter is not."""
        z, beyond = self.walled(z)
        out = np.empty((len(z), self.problem.segments.count))
        for rows in self.chunks(len(z)):
            out[rows] = self.terms(self.projected(z[rows]))
        return np.where(beyond[:, None], -np.inf, out)

    def walled(
        self, z: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points size"], Bool[np.ndarray, " points"]]:
        """Points moved to where positive parameters of effects are 0 at least, and which of them had to be."""
        z, floor = np.asarray(z, dtype=float), self.problem.floor
        return np.maximum(z, floor), (z < floor).any(1)

    def chunks(self, points: int, variants: int = 1) -> Iterator[slice]:
        """Points whose residuals, `variants` each, fit in memory together."""
        size = max(1, MAX_VALUES // (variants * self.latent.basis[..., 0].size))
        for begin in range(0, points, size):
            yield slice(begin, min(begin + size, points))

    def terms(self, projected: Float[np.ndarray, "segments stacked points"]) -> Float[np.ndarray, "points segments"]:
        """log likelihood of each segment; -inf where its simulation diverged."""
        terms = self.normalizer[:, None] - 0.5 * np.einsum("snk,snk->sk", projected, projected)
        return np.where(np.isfinite(terms), terms, -np.inf).T

    def by_recording(self, terms: Float[np.ndarray, "points segments"]) -> Float[np.ndarray, "points recordings"]:
        """Segments' terms summed over each recording."""
        out = np.zeros((len(terms), len(self.problem.segments.recordings)))
        for s, r in enumerate(self.problem.segments.recording):
            out[:, r] += terms[:, s]
        return out

    def log_likelihood_by_recording(
        self, z: Float[np.ndarray, "points size"]
    ) -> Float[np.ndarray, "points recordings"]:
        """log p(recording | z)."""
        return self.by_recording(self.log_likelihood_by_segment(z))

    def log_likelihood(self, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, " points"]:
        """log p(y | z)."""
        return self.log_likelihood_by_recording(z).sum(1)

    def log_density(self, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, " points"]:
        """log p(y | z) + log N(z; 0, I)."""
        return self.log_likelihood(z) + log_prior(np.asarray(z, dtype=float))

    def value_and_grad(
        self, z: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points size"]]:
        """log density and its gradient: central differences in one batch (C), forward mode (MJX)."""
        z = np.asarray(z, dtype=float)
        if self.problem.simulator.engine.name == "mjx":
            from det2stoc_bayes.density_jax import batched_value_and_grad

            value, gradient = batched_value_and_grad(self)(z)
        else:
            terms, gradient = self.terms_and_grad(z)
            value = terms.sum(1)
        return value + log_prior(z), gradient - z

    def terms_and_grad(
        self, z: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points recordings"], Float[np.ndarray, "points size"]]:
        """log likelihood by recording; its sum's gradient by central differences.

        Along posterior axes; where psi varies by recording, along the unknowns, all recordings' own ones at once.
        """
        directions, (z, beyond) = self._directions, self.walled(z)
        terms, gradients = np.empty((len(z), self.problem.segments.count)), np.empty(z.shape)
        variants = 1 + 2 * len(directions)
        steps = np.concatenate([np.zeros((1, self.size)), directions, -directions])
        for rows in self.chunks(len(z), variants):
            projected = self.projected((z[rows, None] + steps).reshape(-1, self.size))
            terms[rows] = self.terms(projected[..., ::variants])
            projected = projected.reshape(*projected.shape[:2], -1, variants)
            above, below = projected[..., 1 : 1 + len(directions)], projected[..., 1 + len(directions) :]
            slope = np.einsum("snp,snpk->spk", projected[..., 0], above - below) / 2
            # A neighbour that diverges tells nothing: no force along that axis.
            gradients[rows] = self._along_unknowns(-np.nan_to_num(slope, nan=0.0))
        self.problem.simulator.counter.gradients += len(z)
        terms[beyond] = -np.inf
        return self.by_recording(terms), gradients

    @cached_property
    def _directions(self) -> Float[np.ndarray, "directions size"]:
        if not self.problem.unknowns.varying:
            return STEP * self.scale.T
        sd = STEP * np.sqrt((self.scale**2).sum(1))
        return np.stack([np.where(np.isin(np.arange(self.size), p), sd, 0.0) for p in self.problem.probes()])

    def _along_unknowns(
        self, change: Float[np.ndarray, "segments points directions"]
    ) -> Float[np.ndarray, "points size"]:
        """Gradient in z from the change of each segment's term along each direction."""
        if not self.problem.unknowns.varying:
            return np.linalg.solve(self.scale.T, change.sum(0).T / STEP).T
        out = np.empty((change.shape[1], self.size))
        for k, moved in enumerate(self.problem.probes()):
            for r, i in enumerate(moved):
                mine = self.problem.segments.recording == r if len(moved) > 1 else slice(None)
                out[:, i] = change[mine, :, k].sum(0) / self._directions[k, i]
        return out

    def jax_log_density(self) -> Callable[[Any], Any]:
        """log_density of one z for jax: traceable, chains under vmap in one batch, reverse mode.

        Turns 64-bit mode on for the process: callbacks run on other threads, where a local setting is lost.
        """
        from det2stoc_bayes.density_jax import jax_log_prior, jax_terms

        terms = jax_terms(self)
        return lambda z: terms(z).sum() + jax_log_prior(z)

    def numpyro_model(self, terms: Callable[[Any], Any] | None = None) -> Callable[[], None]:
        """The same density as a NumPyro model: `z`, every unknown by name, the likelihood as a factor.

        `terms` replaces how the likelihood by recording is computed for jax.
        """
        from det2stoc_bayes.density_jax import numpyro_model

        return numpyro_model(self, terms)


def log_prior(z: Float[np.ndarray, "*points size"]) -> Float[np.ndarray, "*points"]:
    """log N(z; 0, I)."""
    return -0.5 * ((z**2).sum(-1) + z.shape[-1] * np.log(2 * np.pi))


def scale_of(precision: Float[np.ndarray, "size size"]) -> Float[np.ndarray, "size size"]:
    """Lower-triangular L with L L' the inverse of a precision."""
    # Unit diagonal first: the unknowns' precisions may differ by many orders.
    d = 1.0 / np.sqrt(np.diag(precision))
    return d[:, None] * np.linalg.cholesky(np.linalg.inv(precision * np.outer(d, d)))
