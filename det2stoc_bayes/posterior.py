"""What a method returns: one DataTree, the same groups and attributes for every method; to file and back."""

import json
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from xarray import DataTree as DataTree  # what every method returns; only here and in reports is xarray imported

from det2stoc_bayes.density import Density, log_prior
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.files import atomic_write
from det2stoc_bayes.mismatch.evidence import CHANCE
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.vector_density import AnyDensity, Inferred, VectorDensity
from det2stoc_bayes.vector_problem import Posed

PACKAGES = (
    "det2stoc-bayes",
    "numpy",
    "jax",
    "mujoco",
    "mujoco-mjx",
    "numpyro",
    "blackjax",
    "emcee",
    "arviz",
    "xarray",
)
GROUPS = ("posterior", "unconstrained_posterior", "sample_stats", "observed_data", "log_likelihood")
PREDICTIVE = ("observed_data", "predictions")  # groups of a method that infers no psi
ATTRIBUTES = (
    "method", "options", "seed", "versions", "seconds_compile", "seconds_run", "simulations", "gradients",
    "noise_inflation",
)  # fmt: skip
Progress = Callable[[int, int], None]  # done, of how many
Variables = Mapping[str, tuple[tuple[str, ...], Any]]


@dataclass
class Cost:
    """What a method used up, filled in by `measured`; the method itself reports its compilation."""

    seconds_compile: float = 0.0
    seconds_run: float = 0.0
    simulations: int = 0
    gradients: int = 0
    _begun: tuple[float, int, int] = field(default=(0.0, 0, 0), repr=False)

    def stop(self, problem: Inferred) -> None:
        """Read clock and counter."""
        began, simulations, gradients = self._begun
        self.seconds_run = time.perf_counter() - began - self.seconds_compile
        self.simulations = problem.counter.simulations - simulations
        self.gradients = problem.counter.gradients - gradients


@contextmanager
def measured(problem: Inferred) -> Iterator[Cost]:
    """Time and simulations of a method, from the search for the MAP on; libraries' warnings are silenced."""
    counter = problem.counter
    cost = Cost(_begun=(time.perf_counter(), counter.simulations, counter.gradients))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield cost


def build(
    density: AnyDensity,
    z: Float[np.ndarray, "chain draw size"],
    *,
    method: str,
    options: Mapping[str, Any],
    seed: int,
    cost: Cost,
    sample_stats: Mapping[str, Any],
    log_likelihood: Float[np.ndarray, "chain draw recordings"],
) -> xr.DataTree:
    """The DataTree of draws z. A statistic is an array (chain, draw), or (dimensions, array)."""
    problem, lead = density.problem, ("chain", "draw")
    if isinstance(density, VectorDensity):
        z, log_likelihood = density.told(z, log_likelihood)
    flat = z.reshape(-1, density.size)
    draws = named_draws(problem, z)
    lp = (log_likelihood.sum(-1).reshape(-1) + log_prior(flat)).reshape(z.shape[:2])
    stats = {"lp": lp} | dict(sample_stats)
    recording = list(problem.recordings)
    cost.stop(problem)
    groups = {
        "posterior": xr.Dataset(draws, {"recording": recording} if problem.unknowns.varying else {}),
        "unconstrained_posterior": xr.Dataset({"z": ((*lead, "unknown"), z)}, {"unknown": list(problem.names)}),
        "sample_stats": xr.Dataset({k: v if isinstance(v, tuple) else (lead, np.asarray(v)) for k, v in stats.items()}),
        "observed_data": observed_data(problem),
        "log_likelihood": xr.Dataset({"values": ((*lead, "recording"), log_likelihood)}, {"recording": recording}),
    }
    if isinstance(density, Density) and density.problem.measurement.degrees_of_freedom is None:
        # Of heavy tails no sum of squares is known.
        groups["constant_data"] = _constants(density, recording)
    for name in ("posterior", "unconstrained_posterior", "sample_stats", "log_likelihood"):
        groups[name] = groups[name].assign_coords(chain=np.arange(z.shape[0]), draw=np.arange(z.shape[1]))
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = _attributes(problem, method, options, seed, cost) | {"noise_inflation": _inflation(density)}
    return tree


def _constants(density: Density, recordings: list[str]) -> xr.Dataset:
    """By recording: the log likelihood of no error, and the values that initial states leave free.

    Twice what a draw lacks of the former is a sum of as many squares.
    """
    segments, states = density.problem.segments, density.latent.prior_sd.shape[1]
    free = (density.latent.weight > 0).sum(1) - states
    owner = np.arange(len(recordings))[:, None] == segments.recording
    variables = {"log_peak": owner @ density.normalizer, "free_values": owner @ free}
    return xr.Dataset({n: (("recording",), v) for n, v in variables.items()}, {"recording": recordings})


def _attributes(problem: Inferred, method: str, options: Mapping[str, Any], seed: int, cost: Cost) -> dict[str, Any]:
    return {
        "method": method,
        "engine": problem.engine,
        "options": json.dumps(dict(options), sort_keys=True),
        "seed": seed,
        "versions": json.dumps(versions(), sort_keys=True),
        "seconds_compile": cost.seconds_compile,
        "seconds_run": cost.seconds_run,
        "simulations": cost.simulations,
        "gradients": cost.gradients,
    }


def build_vectors(
    names: Sequence[str],
    theta: Float[np.ndarray, "chain draw size"],
    z: Float[np.ndarray, "chain draw size"],
    **attributes: Any,
) -> xr.DataTree:
    """The DataTree of draws of a problem of vectors, which has no recordings; `attributes` are told as they are."""
    lead = ("chain", "draw")
    posterior = {name: (lead, theta[..., k]) for k, name in enumerate(names)}
    unconstrained = xr.Dataset({"z": ((*lead, "unknown"), z)}, {"unknown": list(names)})
    groups = {"posterior": xr.Dataset(posterior), "unconstrained_posterior": unconstrained}
    tree = xr.DataTree.from_dict(groups | {"sample_stats": xr.Dataset()})
    tree.attrs = {"simulations": 0, "seconds_run": 0.0} | attributes
    return tree


def build_predictive(
    problem: Problem,
    predictions: Variables,
    *,
    method: str,
    options: Mapping[str, Any],
    seed: int,
    cost: Cost,
) -> xr.DataTree:
    """The DataTree of a method that predicts, and infers no psi."""
    cost.stop(problem)
    tree = xr.DataTree.from_dict({"observed_data": observed_data(problem)})
    tree.attrs = _attributes(problem, method, options, seed, cost) | {"noise_inflation": float("nan")}
    return with_groups(tree, predictions=predictions)


def with_groups(tree: xr.DataTree, **groups: Variables) -> xr.DataTree:
    """The tree with further groups of (dimensions, array) by name; an empty one is left out."""
    for name, variables in groups.items():
        if variables:
            tree[name] = xr.DataTree(xr.Dataset(dict(variables)))
    return tree


def _inflation(density: AnyDensity) -> float:
    """Squared misfit at the mode over what the noise would leave, less chance; NaN where noise was not declared."""
    if isinstance(density, VectorDensity):
        return float("nan")
    problem = density.problem
    if any(c not in problem.simulator.study.noise for c in problem.segments.columns):
        return float("nan")
    chi2 = float(np.square(density.projected(density.center[None])).sum()) / density.temper
    free = max(density.latent.degrees_of_freedom - problem.size, 1)
    return max(chi2 / problem.measurement.mean_square / free - CHANCE * np.sqrt(2 / free), 0.0)


def variable_name(name: str) -> str:
    """An unknown's name in a DataTree, where a slash would mean a group."""
    return name.replace("/", ".")


def named_draws(
    problem: Inferred, z: Float[np.ndarray, "chain draw size"], rename: Callable[[str], str] = variable_name
) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Draws in their own units; a psi that varies is one variable with dim recording, beside `_mu` and `_sigma`."""
    lead, values = ("chain", "draw"), problem.constrained(z)
    out: dict[str, tuple[tuple[str, ...], np.ndarray]] = {}
    for block in problem.unknowns.varying:
        name = block.parameter.name
        own = [values.pop(f"{name}[{r}]") for r in problem.unknowns.recordings]
        out[rename(name)] = ((*lead, "recording"), np.stack(own, -1))
    return {rename(n): (lead, np.asarray(v)) for n, v in values.items()} | out


def observed_data(problem: Inferred) -> xr.Dataset:
    """Recorded values and times by recording, padded with NaN; of a problem of vectors x as it is."""
    if isinstance(problem, Posed):
        return xr.Dataset({"x": (("feature",), problem.x)})
    segments = problem.segments
    count = len(segments.recordings)
    lengths = [sum(_length(segments.time[s]) for s in np.flatnonzero(segments.recording == r)) for r in range(count)]
    time = np.full((count, max(lengths)), np.nan)
    values = np.full((*time.shape, len(segments.columns)), np.nan)
    filled = [0] * count
    for s, r in enumerate(segments.recording):
        n, a = _length(segments.time[s]), filled[r]
        time[r, a : a + n], values[r, a : a + n] = segments.time[s, :n], segments.values[s, :n]
        filled[r] = a + n
    names = [r.name for r in segments.recordings]
    return xr.Dataset(
        {"time": (("recording", "sample"), time), "values": (("recording", "sample", "column"), values)},
        {"recording": names, "column": list(segments.columns)},
    )


def _length(time: Float[np.ndarray, " samples"]) -> int:
    """Samples of a segment without its padding (which repeats the last time)."""
    return int(np.searchsorted(time, time[-1])) + 1


@cache
def versions() -> dict[str, str]:
    """Installed versions of what a result depends on."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def save(tree: xr.DataTree, path: str | os.PathLike[str]) -> None:
    """Write a DataTree, whole or not at all."""
    atomic_write(path, to_bytes(tree))


def to_bytes(tree: xr.DataTree) -> bytes:
    """A DataTree as a netCDF file's content: HDF5 that cannot finish a file takes the process with it."""
    content = tree.to_netcdf(None, engine="h5netcdf")
    return bytes(content)


def num_draws(tree: xr.DataTree) -> int:
    """Draws of all chains; 0 of a method that infers no psi."""
    return int(np.prod([tree["posterior"].sizes[d] for d in ("chain", "draw")])) if "posterior" in tree.children else 0


def load_made(path: Path, asked: Mapping[str, Any]) -> xr.DataTree | None:
    """The DataTree in a file that was made as asked (attribute `asked`); None where there is none."""
    try:
        tree = load(path)
    except Det2StocError:
        return None
    return tree if tree.attrs.get("asked") == json.dumps(dict(asked), sort_keys=True) else None


def load(path: str | os.PathLike[str]) -> xr.DataTree:
    """Read a DataTree into memory; a Det2StocError where the file is missing, damaged or something else.

    Of a folder, its fit.nc.
    """
    path = Path(path)
    path = path / "fit.nc" if path.is_dir() else path
    if not path.is_file():
        raise Det2StocError(f"{path}: no such file; allowed: a fit written by det2stoc (.nc)")
    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            tree = tree.load()
    except Exception as error:  # h5py, h5netcdf and xarray raise whatever they meet in a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise Det2StocError(f"{path}: cannot be read ({reason}); allowed: a fit written by det2stoc (.nc)") from error
    if {"before", "after"} <= set(tree.children):
        raise Det2StocError(f"{path}: is a diagnosis's; allowed: a fit written by `det2stoc fit` (.nc)")
    groups = PREDICTIVE if set(PREDICTIVE) <= set(tree.children) and "posterior" not in tree.children else GROUPS
    missing = [g for g in groups if g not in tree.children] + [a for a in ATTRIBUTES if a not in tree.attrs]
    if missing:
        raise Det2StocError(f"{path}: lacks {', '.join(missing)}; allowed: a fit written by det2stoc (.nc)")
    return tree
