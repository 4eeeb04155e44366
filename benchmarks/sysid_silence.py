"""What mujoco.sysid says when dry friction was left out: a wrong damping, a narrow interval, no warning.

    python benchmarks/sysid_silence.py            a pendulum of known friction, released from rest
    python benchmarks/sysid_silence.py STUDY      a study folder, as written by det2stoc_bayes.blind.conceal

Needs the packages of `mujoco[sysid]`. Two of its habits are worked around, in its favour: controls are given
at the model's timestep, since it interpolates between samples, and states are compared rather than sensors,
which it stamps one step late.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import mujoco
import numpy as np
from mujoco import sysid

from det2stoc_bayes.blind.laws import Effect
from det2stoc_bayes.blind.reality import simulate_reality
from det2stoc_bayes.blind.systems import SYSTEMS, Psi
from det2stoc_bayes.blind.text import csv_text, study_text

DAMPING, FRICTION = 0.05, 0.08


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A parameter's value with the half-width of its 95 % interval."""

    value: float
    half_width: float


@dataclasses.dataclass(frozen=True)
class Fit:
    """What mujoco.sysid returned, the warnings that it gave, and the misfit in noise sds that it leaves."""

    estimates: dict[str, Estimate]
    warnings: list[str]
    misfit: float
    seconds: float


class _Listener(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.said: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.said.append(record.getMessage())


def write_pendulum(folder: Path) -> None:
    """A pendulum with damping as its only psi; in reality dry friction is there too."""
    only = (Psi("damping", "joint/pivot/damping", "LogNormal", {"loc": -3.0, "scale": 0.6}),)
    system = dataclasses.replace(SYSTEMS["pendulum"], psi=only)
    friction = Effect("coulomb_friction", "joint", "pivot", {"force": FRICTION})
    rng, times = np.random.default_rng(0), 0.01 * np.arange(400)
    (folder / "recordings").mkdir(parents=True)
    (folder / "model.xml").write_text(system.xml())
    (folder / "study.toml").write_text(study_text(system))
    for index, angle in enumerate((0.8, -1.0, 1.2, -1.4)):
        start, inputs = np.array([angle, 0.0]), 0.4 * system.draw_inputs(rng, times)
        columns = simulate_reality(system, {"damping": DAMPING}, (friction,), start, times, inputs).columns
        columns[1:] += system.noise() * rng.standard_normal(columns[1:].shape)  # released from a known rest
        (folder / "recordings" / f"rec_{index}.csv").write_text(csv_text(system, ["torque"], times, columns, inputs))


def fit_study(folder: Path) -> Fit:
    """Fit a study's psi with mujoco.sysid; each recording starts from its first sample."""
    table = tomllib.loads((folder / "study.toml").read_text())
    psi = []
    for name, entry in table["psi"].items():
        ((prior, arguments),) = entry["prior"].items()
        psi.append(Psi(name, entry["target"], prior, arguments, (entry.get("index") or [None])[0]))
    spec = mujoco.MjSpec.from_file(str(folder / "model.xml"))
    model = spec.compile()
    measured, controls, starts, names = [], [], [], []
    for path in sorted(folder.glob(table["recordings"])):
        one = _read(path, model)
        names.append(path.stem)
        for group, part in zip((starts, controls, measured), one, strict=True):
            group.append(part)
    logging.getLogger("absl").setLevel(logging.ERROR)  # states without sensors make it warn at each recording
    sequences = sysid.ModelSequences("study", spec, names, starts, controls, measured, allow_missing_sensors=True)
    parameters = sysid.ParameterDict()
    for entry in psi:
        low, high = entry.support()
        typical = entry.arguments["loc"] if entry.prior != "LogNormal" else np.exp(entry.arguments["loc"])
        parameters.add(sysid.Parameter(entry.name, typical, low, high))

    def build(values: sysid.ParameterDict, source: mujoco.MjSpec) -> mujoco.MjModel:
        built = source.compile()
        for entry in psi:
            entry.write(built, float(values[entry.name].value[0]))
        mujoco.mj_setConst(built, mujoco.MjData(built))
        return built

    residual = sysid.build_residual_fn(models_sequences=[sequences], build_model=build, n_threads=1)
    logging.getLogger("absl").setLevel(logging.WARNING)
    listener, began = _Listener(), time.perf_counter()
    logging.getLogger("absl").addHandler(listener)
    with contextlib.redirect_stdout(io.StringIO()):  # its table of iterations; warnings go to the logger
        found, result = sysid.optimize(parameters, residual, verbose=False)
    residuals, predicted, recorded = residual(found.as_vector(), found)
    _, widths = sysid.calculate_intervals(residuals, result.jac)
    logging.getLogger("absl").removeHandler(listener)
    values = found.as_vector()
    estimates = {e.name: Estimate(float(values[i]), float(widths[i])) for i, e in enumerate(psi)}
    misfit = _misfit(table["noise"], model, predicted, recorded)
    return Fit(estimates, listener.said, misfit, time.perf_counter() - began)


def _joint_columns(model: mujoco.MjModel) -> list[str]:
    joints = [model.joint(j).name for j in range(model.njnt)]
    return [f"{kind}/{joint}" for kind in ("qpos", "qvel") for joint in joints]


def _read(path: Path, model: mujoco.MjModel) -> tuple[np.ndarray, sysid.TimeSeries, sysid.TimeSeries]:
    header = path.read_text().splitlines()[0].split(",")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    columns = _joint_columns(model)
    times, states = table[:, 0], table[:, [header.index(column) for column in columns]]
    inputs = table[:, [header.index(f"ctrl/{model.actuator(i).name}") for i in range(model.nu)]]
    count = round((times[-1] - times[0]) / model.opt.timestep)
    fine = times[0] + model.opt.timestep * np.arange(count + 1)
    held = np.clip(np.searchsorted(times, fine + 1e-9, side="right") - 1, 0, times.size - 1)
    kinds = {"qpos": sysid.SignalType.MjStateQPos, "qvel": sysid.SignalType.MjStateQVel}
    signals = [(column.split("/")[1], kinds[column.split("/")[0]]) for column in columns]
    start = sysid.create_initial_state(model, states[0, : model.nq], states[0, model.nq :])
    control = sysid.TimeSeries.from_control_names(fine, inputs[held], model)
    return start, control, sysid.TimeSeries.from_names(times, states, model, signals)


def _misfit(noise: dict[str, float], model: mujoco.MjModel, predicted: list, recorded: list) -> float:
    sds = np.array([noise[column] for column in _joint_columns(model)])
    pairs = zip(predicted, recorded, strict=True)
    squares = [np.mean(((p[0].data - r[0].data) / sds) ** 2) for p, r in pairs]
    return float(np.sqrt(np.mean(squares)))


def main() -> None:
    """Fit, and print estimates beside the truth where it is known."""
    if not hasattr(sysid, "optimize"):  # mujoco.sysid imports as an empty package without its extras
        raise SystemExit("mujoco.sysid lacks its packages; install them with: pip install 'mujoco[sysid]'")
    truth: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(scratch)
        if len(sys.argv) == 1:
            write_pendulum(folder)
            truth = {"damping": DAMPING}
            print(f"Reality: damping {DAMPING}, dry friction {FRICTION} N m that the model leaves out.")
        fit = fit_study(folder)
    for name, estimate in fit.estimates.items():
        line = f"mujoco.sysid: {name} = {estimate.value:.4f} +- {estimate.half_width:.4f} (95 %)"
        if name in truth:
            off = (estimate.value - truth[name]) / max(estimate.half_width, 1e-12)
            line += f"; truth {truth[name]}, {off:.0f} half-widths away"
        print(line)
    print(f"warnings given: {len(fit.warnings)}" + "".join(f"\n  {text}" for text in fit.warnings))
    print(f"rollouts miss the recordings by {fit.misfit:.1f} noise sds (1 is right); {fit.seconds:.1f} s")


if __name__ == "__main__":
    main()
