"""Which unknown is what: a psi that never varies is one, a psi that varies by recording is a population's.

For psi that varies, psi_k ~ Normal(mu, sigma) truncated to the prior's support, with mu ~ prior and
sigma ~ HalfNormal(sd of the prior / 2), written with standard normals alone: z_mu, e_k (and z_sigma).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.priors import Prior
from det2stoc_bayes.quantiles import library, truncated_normal
from det2stoc_bayes.study import Parameter

Array = Any  # numpy or jax array
TANGENT_STEP = 1e-4  # of a prior sd
LEAST_SPREAD = 1e-3  # of the prior's sd: a population narrower than this is one value


@dataclass(frozen=True)
class Block:
    """The unknowns of one psi: `mu`, then `sigma` where it is unknown, then one for each recording."""

    parameter: Parameter
    begin: int
    recordings: int  # 0: never varies
    spread: float | None  # sigma where it is held; None: unknown, or nothing varies

    @property
    def varies(self) -> bool:
        """Whether each recording has its own value."""
        return self.recordings > 0

    @property
    def first_own(self) -> int:
        """Index of the first recording's own unknown."""
        return self.begin + (1 if self.spread is not None else 2)

    @property
    def stop(self) -> int:
        """Index after the block."""
        return self.first_own + self.recordings if self.varies else self.begin + 1

    @property
    def sigma_prior(self) -> Prior:
        """Of the population's sd."""
        return Prior("HalfNormal", {"scale": self.parameter.prior.sd / 2})

    def population(self, z: Array, xp: ModuleType = np) -> Array:
        """mu (...)."""
        return self.parameter.prior.from_normal(z[..., self.begin], xp)

    def tangent(self, z: float) -> tuple[float, float]:
        """mu where its unknown is z, and its slope there."""
        low, here, high = self.parameter.prior.from_normal(np.array([z - TANGENT_STEP, z, z + TANGENT_STEP]))
        return float(here), float(high - low) / (2 * TANGENT_STEP)

    def sigma(self, z: Array, xp: ModuleType = np) -> Array:
        """sd of the population (...)."""
        if self.spread is not None:
            return self.spread + 0.0 * z[..., self.begin]
        return self.sigma_prior.from_normal(z[..., self.begin + 1], xp)

    def values(self, z: Array, xp: ModuleType = np) -> Array:
        """psi of every recording (..., recordings)."""
        loc, scale = self.population(z, xp)[..., None], self.sigma(z, xp)[..., None]
        return of_population(self.parameter, loc, scale, z[..., self.first_own : self.stop], xp)

    def shared_slopes(self, z: Float[np.ndarray, " size"]) -> Float[np.ndarray, "shared recordings"]:
        """By how much a recording's own unknown would have to move for what mu, and sigma if unknown, do to its value.

        A value reaches the prediction alone, so that this holds of sensitivities as well. NaN where it stands still.
        """
        own = np.where(np.arange(len(z)) >= self.first_own, TANGENT_STEP, 0.0)
        steps = [*(TANGENT_STEP * np.eye(len(z))[self.begin : self.first_own]), own]
        *shared, alone = (self.values(z + step) - self.values(z - step) for step in steps)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(np.abs(alone) > 0, np.array(shared) / alone, np.nan)


@dataclass(frozen=True)
class Unknowns:
    """The layout of psi's unknowns in z."""

    blocks: tuple[Block, ...]
    recordings: tuple[str, ...]

    @property
    def size(self) -> int:
        """Unknowns of psi."""
        return self.blocks[-1].stop if self.blocks else 0

    @property
    def varying(self) -> tuple[Block, ...]:
        """Blocks of psi that vary by recording."""
        return tuple(b for b in self.blocks if b.varies)

    @property
    def names(self) -> tuple[str, ...]:
        """`mass`; or `mass_mu`, `mass_sigma` where it is unknown, `mass[<recording>]` for each recording."""
        out: list[str] = []
        for b in self.blocks:
            name = b.parameter.name
            out += [f"{name}_mu" if b.varies else name]
            out += [f"{name}_sigma"] if b.varies and b.spread is None else []
            out += [f"{name}[{r}]" for r in self.recordings] if b.varies else []
        return tuple(out)

    @property
    def own(self) -> tuple[Int[np.ndarray, " recordings"], ...]:
        """For each psi that varies, its unknowns that each belong to one recording."""
        return tuple(np.arange(b.first_own, b.stop) for b in self.varying)

    @property
    def owned(self) -> Int[np.ndarray, " owned"]:
        """All unknowns that belong to single recordings."""
        return np.concatenate([np.arange(0), *self.own])

    def followed(self, z: Float[np.ndarray, " size"]) -> list[int]:
        """mu, and sigma if unknown, of psi that vary: a prediction tells of them by recordings' own values alone.

        None of a psi that stands still at z.
        """
        moving = [b for b in self.varying if np.isfinite(b.shared_slopes(z)).all()]
        return [i for b in moving for i in range(b.begin, b.first_own)]

    def population(self, z: Array, xp: ModuleType = np) -> Array:
        """One value a psi (..., psi): mu where it varies."""
        columns = [b.population(z, xp) for b in self.blocks]
        return xp.stack(columns, -1) if columns else xp.zeros((*z.shape[:-1], 0))

    def by_recording(self, z: Array, xp: ModuleType = np) -> Array:
        """psi of every recording (..., recordings, psi)."""
        count = len(self.recordings)
        columns = [
            b.values(z, xp) if b.varies else xp.repeat(b.population(z, xp)[..., None], count, -1) for b in self.blocks
        ]
        return xp.stack(columns, -1) if columns else xp.zeros((*z.shape[:-1], count, 0))

    def constrained(self, z: Array, xp: ModuleType = np) -> dict[str, Array]:
        """Every unknown by name in its own unit; a held sigma too."""
        out: dict[str, Array] = {}
        for b in self.blocks:
            name = b.parameter.name
            if not b.varies:
                out[name] = b.population(z, xp)
                continue
            out[f"{name}_mu"], out[f"{name}_sigma"] = b.population(z, xp), b.sigma(z, xp)
            values = b.values(z, xp)
            out |= {f"{name}[{r}]": values[..., k] for k, r in enumerate(self.recordings)}
        return out


def of_population(parameter: Parameter, mu: Array, sigma: Array, z: Array, xp: ModuleType = np) -> Array:
    """Values of Normal(mu, sigma) truncated to the prior's support, from standard normals z."""
    low, high = parameter.prior.support
    if np.isinf(low) and np.isinf(high):
        return mu + sigma * z
    return truncated_normal({"loc": mu, "scale": sigma, "low": low, "high": high}, z, library(xp))


def population_draws(
    parameters: Sequence[Parameter],
    mu: Float[np.ndarray, " psi"],
    sigma: Float[np.ndarray, " psi"],
    normal: Float[np.ndarray, "*many psi"],
) -> Float[np.ndarray, "*many psi"]:
    """Draws of a population of every psi, from standard normals."""
    return np.stack(
        [of_population(p, *row) for p, *row in zip(parameters, mu, sigma, np.moveaxis(normal, -1, 0), strict=True)], -1
    )


def lay_out(parameters: Sequence[Parameter], recordings: Sequence[str], spreads: Sequence[float] | None) -> Unknowns:
    """The layout; `spreads` holds sigma of each psi that varies, None makes them unknowns."""
    blocks: list[Block] = []
    begin, held = 0, iter(spreads or ())
    for p in parameters:
        varies = p.varies == "trajectory"
        spread = next(held) if varies and spreads is not None else None
        blocks.append(Block(p, begin, len(recordings) if varies else 0, spread))
        begin = blocks[-1].stop
    return Unknowns(tuple(blocks), tuple(recordings))


def first_spreads(parameters: Sequence[Parameter]) -> tuple[float, ...]:
    """Medians of sigma's priors, from which the fit of populations starts."""
    return tuple(0.67 * p.prior.sd / 2 for p in parameters if p.varies == "trajectory")


def carried(z: Float[np.ndarray, " size"], old: Unknowns, new: Unknowns) -> Float[np.ndarray, " new_size"]:
    """Unknowns in another layout: a recording keeps its own value, a new one has the population's."""
    out = np.zeros(new.size + len(z) - old.size)
    out[new.size :] = z[old.size :]
    for a, b in zip(old.blocks, new.blocks, strict=True):
        out[b.begin] = z[a.begin]
        if not a.varies:
            continue
        sigma = float(a.sigma(z))
        if b.spread is None:
            out[b.begin + 1] = float(b.sigma_prior.to_normal(max(sigma, 1e-300)))
            ratio = 1.0
        else:
            ratio = sigma / max(b.spread, 1e-300)
        for k, name in enumerate(new.recordings):
            if name in old.recordings:
                out[b.first_own + k] = z[a.first_own + old.recordings.index(name)] * ratio
    return out
