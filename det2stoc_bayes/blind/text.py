"""The study's files as text."""

from collections.abc import Collection, Mapping

import numpy as np

from det2stoc_bayes.blind.systems import System


def study_text(
    system: System,
    *,
    noise: bool = True,
    varying: Collection[str] = (),
    known: Mapping[str, Mapping[str, float]] | None = None,
) -> str:
    """study.toml: the model, uncertain parameters with their priors, the noise, what is known by recording."""
    lines = ['model = "model.xml"', 'recordings = "recordings/*.csv"', 'holdout = "holdout/*.csv"', ""]
    for psi in system.psi:
        arguments = ", ".join(f"{key} = {value!r}" for key, value in psi.arguments.items())
        lines += [f"[psi.{psi.name}]", f'target = "{psi.target}"']
        if psi.index is not None:
            lines.append(f"index = [{psi.index}]")
        lines.append(f"prior = {{ {psi.prior} = {{ {arguments} }} }}")
        lines += ['varies = "trajectory"', ""] if psi.name in varying else [""]
    if noise:
        lines.append("[noise]")
        lines += [f'"{c}" = {sd!r}' for c, sd in zip(system.columns(), system.noise().tolist(), strict=True)]
    for stem, values in (known or {}).items():
        lines += ["", f"[known.{stem}]", *(f'"{target}" = {value!r}' for target, value in values.items())]
    return "\n".join(lines) + "\n"


def csv_text(system: System, controls: list[str], times: np.ndarray, columns: np.ndarray, inputs: np.ndarray) -> str:
    """One recording: time, measured columns, commanded controls; a dropped sample (NaN) is an empty cell."""
    names = ["time", *system.columns(), *(f"ctrl/{name}" for name in controls)]
    table = np.column_stack((times, columns, inputs))
    rows = [",".join("" if np.isnan(value) else f"{value:.9g}" for value in row) for row in table]
    return "\n".join([",".join(names), *rows]) + "\n"
