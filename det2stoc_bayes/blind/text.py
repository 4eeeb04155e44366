"""The study's files as text."""

import numpy as np

from det2stoc_bayes.blind.systems import System


def study_text(system: System) -> str:
    """study.toml: the model, the uncertain parameters with their priors, the noise."""
    lines = ['model = "model.xml"', 'recordings = "recordings/*.csv"', 'holdout = "holdout/*.csv"', ""]
    for psi in system.psi:
        arguments = ", ".join(f"{key} = {value!r}" for key, value in psi.arguments.items())
        lines += [f"[psi.{psi.name}]", f'target = "{psi.target}"']
        if psi.index is not None:
            lines.append(f"index = [{psi.index}]")
        lines += [f"prior = {{ {psi.prior} = {{ {arguments} }} }}", ""]
    lines.append("[noise]")
    lines += [f'"{c}" = {sd!r}' for c, sd in zip(system.columns(), system.noise().tolist(), strict=True)]
    return "\n".join(lines) + "\n"


def csv_text(system: System, times: np.ndarray, columns: np.ndarray, inputs: np.ndarray) -> str:
    """One recording: time, measured columns, commanded controls."""
    names = ["time", *system.columns(), *(f"ctrl/{name}" for name in system.actuators)]
    table = np.column_stack((times, columns, inputs))
    rows = [",".join(f"{value:.9g}" for value in row) for row in table]
    return "\n".join([",".join(names), *rows]) + "\n"
