"""The analytic check: a CVAE on random trivariate Gaussians must reach the exact conditional p(s' | s, a)."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp
from scipy.stats import norm

from det2stoc_bayes.inference._cvae import Cvae, HybridELBO, Schedule, optimize, standard_normal
from det2stoc_bayes.inference._networks import Decoder, Encoder
from det2stoc_bayes.models import trivariate
from det2stoc_bayes.report.trivariate_page import trivariate_page as page
from det2stoc_bayes.reproduce.parts import Progress, kept
from det2stoc_bayes.reproduce.side_by_side import num_jobs, side_by_side, silent
from det2stoc_bayes.transitions import Scaling, Transitions

SHOWN = (0, 100, 500, 2000)  # steps at which the source shows the density
NUM_CONDITIONS = 50
NUM_SHOWN = 3  # conditions of a figure
NODES = 64  # of Gauss-Hermite quadrature
SHAPE = {"width": 100, "depth": 2, "activation": jax.nn.elu, "norm": False}  # the source's
ALLOWED = {"mean": 0.01, "worst": 0.05}  # KL(exact || learned), nats

__all__ = ["page", "run"]


@dataclass(frozen=True)
class Settings:
    """How much is done."""

    num_gaussians: int = 20
    num_steps: int = 4000
    num_samples: int = 200_000

    @classmethod
    def quick(cls) -> "Settings":
        """A look in less than three minutes."""
        return cls(num_gaussians=2, num_steps=2000, num_samples=50_000)


@dataclass(frozen=True, eq=False)
class Trained:
    """A CVAE on one Gaussian, and the same at the steps that are shown."""

    truth: trivariate.Trivariate
    scaling: Scaling
    cvae: Cvae
    snapshots: Mapping[int, Cvae]

    def log_density(
        self, cvae: Cvae, values: Float[np.ndarray, "points values"], given: Float[np.ndarray, "points 2"]
    ) -> Float[np.ndarray, "points values"]:
        """log p(s' | s, a) under the networks, z integrated out by quadrature."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
        x, z = jnp.asarray(self.scaling.inputs(given)), jnp.asarray(nodes[:, None], jnp.float32)
        mean, sd = jax.vmap(lambda x: jax.vmap(lambda z: cvae.decoder(x, z))(z))(x)
        mean, sd = (np.asarray(a, float)[..., 0] for a in (mean, sd))
        y = (values - self.scaling.linear(given)) / self.scaling.change_sd
        each = norm.logpdf(y[:, None, :], mean[..., None], sd[..., None])
        mixed = np.asarray(logsumexp(each, axis=1, b=(weights / weights.sum())[None, :, None]))
        return mixed - self.scaling.log_volume

    def divergences(self, cvae: Cvae, given: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " points"]:
        """KL(exact || learned) at each condition, nats."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
        mean, variance = self.truth.conditional(given)
        values = mean[:, None] + np.sqrt(variance) * nodes
        exact = norm.logpdf(values, mean[:, None], np.sqrt(variance))
        return (exact - self.log_density(cvae, values, given)) @ (weights / weights.sum())


def train(seed: int, settings: Settings, progress: Callable[[int, int], None] = lambda *_: None) -> Trained:
    """A CVAE on the Gaussian of a seed."""
    random = np.random.default_rng(seed)
    truth = trivariate.draw(random)
    draws = truth.sample(random, settings.num_samples)
    data = Transitions(draws[:, 1:2], draws[:, 2:], draws[:, :1], np.zeros(len(draws), int))
    scaling = Scaling.of(data, linear=False)  # the whole conditional is what the network has to learn
    x, y = (jnp.asarray(a) for a in scaling.standard(data))
    keys = jax.random.split(jax.random.key(seed), 3)
    encoder = Encoder(2, 1, 1, keys[0], drop=0.0, **SHAPE)
    first = Cvae(encoder, Decoder(2, 1, 1, keys[1], **SHAPE), standard_normal(1), False)
    snapshots = {0: first}

    def keep(step: int, params: Mapping[str, Any]) -> None:
        if step in SHOWN:
            snapshots[step] = first.with_params(params)

    held, checks = len(x) // 20, settings.num_steps // SHOWN[1]
    schedule = Schedule(settings.num_steps, batch=1000, checks=checks, patience=checks, epochs=np.inf)
    params, _ = optimize(
        HybridELBO(1.0), first.model, first.guide, (x[held:], y[held:]), (x[:held], y[:held]), keys[2], schedule,
        keep=keep, progress=progress,
    )  # fmt: skip
    return Trained(truth, scaling, first.with_params(params), snapshots)


def run(
    out: Path, *, seed: int = 0, quick: bool = False, jobs: int = 0, progress: Progress = lambda *_: None
) -> dict[str, Any]:
    """Every Gaussian's divergences; each is kept in `out` as soon as it is done, and not done again."""
    settings = Settings.quick() if quick else Settings()
    numbers = range(settings.num_gaussians)

    if (jobs := num_jobs(jobs)) > 1:
        make = partial(_case, out, seed, settings, silent)
        side_by_side(make, numbers, jobs, out / "cases", len(numbers), progress)
    return summary([_case(out, seed, settings, progress, number) for number in numbers], settings, seed)


def _case(out: Path, seed: int, settings: Settings, progress: Progress, number: int) -> dict[str, Any]:
    """A Gaussian's divergences, kept."""

    def step(done: int, total: int) -> None:
        progress("training", number * total + done, settings.num_gaussians * total)

    def make() -> dict[str, Any]:
        return {"number": number} | examine([seed, number], settings, step)

    return kept(out / "cases" / f"gaussian_{number:02d}.json", {"seed": seed, **asdict(settings)}, make)


def examine(seed: list[int], settings: Settings, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Divergences of one Gaussian, and the curves of a figure."""
    random = np.random.default_rng(seed)
    trained = train(int(random.integers(2**31)), settings, progress)
    given = trained.truth.sample(random, NUM_CONDITIONS)[:, 1:]
    divergences = trained.divergences(trained.cvae, given)
    shown = given[:NUM_SHOWN]
    mean, variance = trained.truth.conditional(shown)
    grid = np.linspace((mean - 4 * np.sqrt(variance)).min(), (mean + 4 * np.sqrt(variance)).max(), 161)
    values = np.tile(grid, (len(shown), 1))
    every = {str(k): np.exp(trained.log_density(c, values, shown)) for k, c in trained.snapshots.items()}
    by_step = {str(k): float(trained.divergences(c, given).mean()) for k, c in trained.snapshots.items()}
    return {
        "divergences": divergences.tolist(),
        "divergence_by_step": by_step,
        "conditions": shown.tolist(),
        "grid": grid.tolist(),
        "densities": {k: v.round(7).tolist() for k, v in every.items()},
        "exact": norm.pdf(values, mean[:, None], np.sqrt(variance)).tolist(),
    }


def summary(cases: list[dict[str, Any]], settings: Settings, seed: int) -> dict[str, Any]:
    """What the page and results.json hold."""
    all_of_them = np.array([c["divergences"] for c in cases])
    found = {"mean": float(all_of_them.mean()), "worst": float(all_of_them.max())}
    return {
        "experiment": "trivariate",
        "seed": seed,
        "settings": asdict(settings),
        "allowed": ALLOWED,
        "divergence": found,
        "table": {
            "title": f"trivariate, {len(cases)} Gaussians",
            "columns": ["KL(exact || learned) [nat]", "found>", "allowed>"],
            "rows": [[name, found[name], allowed] for name, allowed in ALLOWED.items()],
        },
        "cases": cases,
    }
