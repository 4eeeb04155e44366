"""Fresh experiments with the concealed effects on, with noise, as the files of a study."""

from typing import Any

import numpy as np

from det2stoc_bayes.blind.laws import Effect
from det2stoc_bayes.blind.probe import Probe, experiment
from det2stoc_bayes.blind.reality import simulate_reality
from det2stoc_bayes.blind.sizing import Found
from det2stoc_bayes.blind.text import csv_text, study_text
from det2stoc_bayes.blind.variants import Setting

HOLDOUTS = 3
LEAST = 1.5  # RMS in noise sds that psi cannot absorb, of each effect in the recordings that are fitted


def record(
    rng: np.random.Generator, setting: Setting, probe: Probe, found: list[Found], num_recordings: int
) -> tuple[dict[str, str], dict[str, Any]] | None:
    """The files' texts by name, and more of the answer: the true simulator's held-out error, what varied and how.

    None where an effect hardly shows in what is to be fitted, as a limit that is not reached there.
    """
    system, noise, effects = setting.system, setting.system.noise(), [f.effect for f in found]
    believed = next((f.believed for f in found if f.believed), (None, None))
    model = system.compile(probe.psi)
    controls = [model.actuator(a).name for a in range(model.nu)]
    stems = [f"recordings/rec_{i:02d}" for i in range(1, num_recordings + 1)]
    stems += [f"holdout/hold_{i:02d}" for i in range(1, HOLDOUTS + 1)]
    tables, own, runs = [], {}, []
    for stem in stems:
        values, times = setting.values(rng, probe.psi), setting.times(rng, probe.times)
        start, inputs, run = experiment(rng, system, values, effects, times)
        runs.append((values, start, times, inputs, run.columns))
        tables.append((times, run.columns + noise * rng.standard_normal(run.columns.shape), inputs))
        own[stem.split("/")[1]] = {key: v for key, v in values.items() if v != probe.psi.get(key)}
    if not system.touching and not all(
        _shows(f, effects, probe, runs[:num_recordings]) for f in found if f.believed is None
    ):
        return None
    spoiled = setting.spoil(rng, [columns for _, columns, _ in tables])
    known = {stem: {key: v for key, v in values.items() if "/" in key} for stem, values in own.items()}
    files = {
        "model.xml": system.xml(*believed),
        "study.toml": study_text(
            system,
            noise="unknown_noise" not in setting.variants,
            varying=setting.varying,
            known={stem: values for stem, values in known.items() if values},
        ),
    }
    for stem, (times, _, inputs), columns in zip(stems, tables, spoiled, strict=True):
        files[f"{stem}.csv"] = csv_text(system, controls, times, columns, inputs)
    held = zip(runs[num_recordings:], tables[num_recordings:], strict=True)
    errors = np.concatenate([noisy - run[4] for run, (_, noisy, _) in held])
    answer: dict[str, Any] = {
        "truth_rmse": dict(zip(system.columns(), np.sqrt(np.mean(errors**2, 0)).tolist(), strict=True))
    }
    if not setting.varying:
        return files, answer
    each = {stem: {key: v for key, v in values.items() if "/" not in key} for stem, values in own.items()}
    return files, answer | {"varying": {"spread": setting.varying, "recordings": each}}


def _shows(found: Found, effects: list[Effect], probe: Probe, runs: list[tuple]) -> bool:
    """Whether recordings show enough of an effect, the share that psi absorbs being as in the probe."""
    system, others = probe.system, [e for e in effects if e is not found.effect]
    squares = [
        np.mean(
            ((columns - simulate_reality(system, values, others, start, times, inputs).columns) / system.noise()) ** 2
        )
        for values, start, times, inputs, columns in runs
    ]
    shown = float(np.sqrt(np.mean(squares))) * found.size / found.change
    return not shown < LEAST  # NaN: without the effect some diverge
