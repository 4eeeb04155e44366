"""Fresh experiments with the concealed effects on, with noise, as the files of a study."""

from typing import Any

import numpy as np

from det2stoc_bayes.blind.probe import Probe, experiment
from det2stoc_bayes.blind.sizing import Found
from det2stoc_bayes.blind.text import csv_text, study_text
from det2stoc_bayes.blind.variants import Setting

HOLDOUTS = 3


def record(
    rng: np.random.Generator, setting: Setting, probe: Probe, found: list[Found], num_recordings: int
) -> tuple[dict[str, str], dict[str, Any]]:
    """The files' texts by name, and what varied: the spread of psi and each recording's values."""
    system, noise, effects = setting.system, setting.system.noise(), [f.effect for f in found]
    believed = next((f.believed for f in found if f.believed), (None, None))
    model = system.compile(probe.psi)
    controls = [model.actuator(a).name for a in range(model.nu)]
    stems = [f"recordings/rec_{i:02d}" for i in range(1, num_recordings + 1)]
    stems += [f"holdout/hold_{i:02d}" for i in range(1, HOLDOUTS + 1)]
    tables, own = [], {}
    for stem in stems:
        values, times = setting.values(rng, probe.psi), setting.times(rng, probe.times)
        _, inputs, run = experiment(rng, system, values, effects, times)
        tables.append((times, run.columns + noise * rng.standard_normal(run.columns.shape), inputs))
        own[stem.split("/")[1]] = {key: v for key, v in values.items() if v != probe.psi.get(key)}
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
    if not setting.varying:
        return files, {}
    each = {stem: {key: v for key, v in values.items() if "/" not in key} for stem, values in own.items()}
    return files, {"varying": {"spread": setting.varying, "recordings": each}}
