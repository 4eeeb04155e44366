"""A diagnosis as arrays: the DataTree that becomes fit.nc and feeds the report."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from jaxtyping import Float
from xarray import DataTree

from det2stoc_bayes.mismatch.any_fit import AnyFit
from det2stoc_bayes.mismatch.finding import variable_name
from det2stoc_bayes.mismatch.patch_module import parameter_texts
from det2stoc_bayes.mismatch.race import Ranked, Slot
from det2stoc_bayes.mismatch.where import Condition
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.posterior import named_draws
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import Segments

__all__ = ["DataTree", "fitted_paths", "fitted_states", "posterior", "ranking", "rollouts", "screening"]

NUM_CHAINS = 4


def posterior(fit: AnyFit, z: np.ndarray) -> xr.Dataset:
    """Draws of psi and effect parameters by name, dims chain and draw."""
    problem = fit.problem
    names = {"recording": list(problem.unknowns.recordings)} if problem.unknowns.varying else {}
    return xr.Dataset(named_draws(problem, z.reshape(NUM_CHAINS, len(z) // NUM_CHAINS, problem.size), _variable), names)


def _variable(name: str) -> str:
    if "[" not in name:
        return name
    effect, rest = name.split("[", 1)
    element, parameter = rest.rsplit("].", 1)
    return variable_name(effect, element, parameter)


def rollouts(
    fit: AnyFit,
    before: dict[str, np.ndarray],
    after: dict[str, np.ndarray],
    recordings: tuple[Recording, ...],
    role: str,
    when: list[Condition],
) -> dict[str, xr.Dataset]:
    """One dataset a recording: observed, predicted before and after, whitened residuals, where the condition holds."""
    columns, noise, model = fit.problem.segments.columns, fit.problem.noise, fit.problem.simulator.model
    actuators = [model.actuator(a).name for a in range(model.nu)]
    out = {}
    for r in recordings:
        observed = np.full((len(r.time), len(columns)), np.nan)
        for j, column in enumerate(r.columns):
            if column in columns:  # a held-out recording may have more
                observed[:, columns.index(column)] = r.values[:, j]
        seen = slice(0, len(before[r.name]))
        paths = {"before": before[r.name], "after": after[r.name]}
        data = {"observed": observed[seen]} | paths
        data |= {f"residual_{k}": (observed[seen] - v) / noise for k, v in paths.items()}
        variables: dict[str, tuple] = {k: (("sample", "channel"), v) for k, v in data.items()}
        held = holding(r, when, actuators)
        if held is not None:
            variables["condition"] = (("sample",), held[seen])
        variables["noise_sd"] = (("channel",), noise)
        coords = {"channel": list(columns), "time": (("sample",), r.time[seen])}
        out[r.name] = xr.Dataset(variables, coords, {"role": role})
    return out


def fitted_paths(fit: Fit) -> dict[str, np.ndarray]:
    """Predictions (samples, columns) of every fitted recording from the initial states of its segments' fit."""
    problem, segments = fit.problem, fit.problem.segments
    predicted = problem.simulator.rollout(problem.request(fit.point.z[None], fit.point.start))
    if problem.finer is not None:
        predicted = predicted + problem.finer.shift
    return _by_recording(segments, predicted)


def fitted_states(fit: Fit) -> dict[str, np.ndarray]:
    """The positions (samples, nq) behind `fitted_paths`."""
    problem, segments = fit.problem, fit.problem.segments
    found = problem.simulator.engine.trajectory(problem.request(fit.point.z[None], fit.point.start)).qpos
    return _by_recording(segments, found)


def _by_recording(segments: Segments, paths: Float[np.ndarray, "segments samples width"]) -> dict[str, np.ndarray]:
    """What segments have, in the samples of their recordings; NaN between them."""
    out = {r.name: np.full((len(r.time), paths.shape[-1]), np.nan) for r in segments.recordings}
    for s, path in enumerate(paths):
        begin, length = segments.first[s], segments.lengths[s]
        out[segments.recordings[segments.recording[s]].name][begin : begin + length] = path[:length]
    return out


def holding(recording: Recording, when: Sequence[Condition], actuators: Sequence[str]) -> np.ndarray | None:
    """Where the first condition holds whose variable was recorded or commanded."""
    known = dict(zip((f"ctrl/{name}" for name in actuators), recording.ctrl.T, strict=True))
    known |= dict(zip(recording.columns, recording.values.T, strict=True))
    return next((c.holds(known[c.variable]) for c in when if c.variable in known), None)


def screening(slot: Slot, probability: dict[str, float]) -> xr.Dataset:
    """Every candidate of the first slot with its evidence; refined ones with the refined figure."""
    refined = {r.placed.label: r for r in slot.ranked}
    rows = []
    for s in slot.screened:
        effect, at, r = s.placed.effect, s.placed.element, refined.get(s.placed.label)
        gain, chance = s.log_evidence if r is None else r.gain, probability.get(s.placed.label, 0.0)
        rows.append((effect.name, at.kind, at.name, gain, chance, "" if r is None else _size(r)))
    return ranking(rows)


def ranking(rows: list[tuple[str, str, str, float, float, str]]) -> xr.Dataset:
    """Candidates as (name, kind, element, log evidence, probability, size), most evidence first."""
    rows.sort(key=lambda row: -row[3])
    names = ("name", "kind", "element", "log_evidence", "probability", "size")
    return xr.Dataset({n: (("candidate",), list(v)) for n, v in zip(names, zip(*rows, strict=True), strict=True)})


def _size(ranked: Ranked) -> str:
    """Refined parameter values, as `amplitude = 0.1 N m, cycles = 6 1/rad`."""
    problem = ranked.fit.problem
    values = problem.effect_values(ranked.fit.point.z[None])[-1]
    return ", ".join(parameter_texts(ranked.placed, {name: value[0] for name, value in values.items()}))
