"""Studies of MJCF models that are recorded in simulation under a known psi: command, trajectory, noise, files."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.files import atomic_write

FREQUENCIES = (0.3, 1.5)  # of a command's sines [Hz]
NUM_SINES = 3


@dataclass(frozen=True)
class Psi:
    """A normal prior that ends at `low` and `high`; `component` of a field that is a vector."""

    target: str
    loc: float
    scale: float
    low: float
    high: float
    component: int | None = None

    @property
    def table(self) -> str:
        """As study.toml says it."""
        prior = f"loc = {self.loc}, scale = {self.scale}, low = {self.low}, high = {self.high}"
        index = "" if self.component is None else f"index = [{self.component}]\n"
        return f'target = "{self.target}"\n{index}prior = {{ TruncatedNormal = {{ {prior} }} }}\n'

    def write(self, model: mujoco.MjModel, value: float) -> None:
        """Into a compiled model."""
        kind, name, field = self.target.split("/")
        row = getattr(model, kind)(name)
        getattr(row, field)[self.component or 0] = value


@dataclass(frozen=True)
class Recorded:
    """A model, its psi, and how it is recorded: noise by joint for (qpos, qvel), starts and commands at random."""

    model: Path
    psi: Mapping[str, Psi]
    noise: Mapping[str, tuple[float, float]]
    start: tuple[float, ...]  # positions and velocities at the start are normal with these sds
    amplitude: float  # of the command's sines
    num_recordings: int = 3
    num_samples: int = 60
    steps_per_sample: int = 10

    @property
    def columns(self) -> tuple[str, ...]:
        """What is recorded, besides time and commands."""
        return tuple(f"{kind}/{joint}" for kind in ("qpos", "qvel") for joint in self.noise)

    def write_study(self, folder: Path, values: Mapping[str, float], *, seed: int = 0) -> Path:
        """A study's folder with recordings simulated under `values`."""
        (folder / "recordings").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(self.model, folder / "model.xml")
        tables = [f"[psi.{name}]\n{psi.table}" for name, psi in self.psi.items()]
        sds = {f"{kind}/{j}": sd[k] for k, kind in enumerate(("qpos", "qvel")) for j, sd in self.noise.items()}
        noise = "".join(f'"{column}" = {sds[column]}\n' for column in self.columns)
        atomic_write(folder / "study.toml", 'model = "model.xml"\n\n' + "\n".join(tables) + "\n[noise]\n" + noise)
        model = mujoco.MjModel.from_xml_path(str(self.model))
        for name, value in values.items():
            self.psi[name].write(model, value)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        random = np.random.default_rng(seed)
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in range(model.nu)]
        head = ",".join(["time", *self.columns, *(f"ctrl/{name}" for name in names)])
        for r in range(self.num_recordings):
            time, states, commands = self._record(model, random)
            states = states + np.array([sds[c] for c in self.columns]) * random.standard_normal(states.shape)
            rows = np.column_stack([time, states, commands])
            lines = [",".join(f"{value:.17g}" for value in row) for row in rows]
            atomic_write(folder / "recordings" / f"run_{r + 1}.csv", "\n".join([head, *lines, ""]))
        return folder

    def _record(
        self, model: mujoco.MjModel, random: np.random.Generator
    ) -> tuple[
        Float[np.ndarray, " samples"], Float[np.ndarray, "samples columns"], Float[np.ndarray, "samples commands"]
    ]:
        """Times, states without noise, and the commands, each held until the next sample."""
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = np.reshape(random.normal(0.0, self.start), (2, -1))
        time = np.arange(self.num_samples) * self.steps_per_sample * model.opt.timestep
        frequency, phase = random.uniform(*FREQUENCIES, NUM_SINES), random.uniform(0, 2 * np.pi, NUM_SINES)
        command = self.amplitude * np.sin(2 * np.pi * frequency * time[:, None] + phase).mean(1, keepdims=True)
        states = []
        for now in command:
            states.append(np.concatenate([data.qpos, data.qvel]))
            data.ctrl[:] = now
            for _ in range(self.steps_per_sample):
                mujoco.mj_step(model, data)
        return time, np.stack(states), np.repeat(command, model.nu, 1)
