"""A believed system: MJCF, uncertain parameters with priors, noise, and how experiments are drawn."""

from copy import copy
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache

import mujoco
import numpy as np
from scipy import stats

HEADER = """<mujoco model="{title}">
  <option timestep="{timestep}" integrator="{integrator}" gravity="0 0 -9.81"{medium}/>
  <default>
    <geom contype="0" conaffinity="0"/>
  </default>
"""
FREE_PARTS = {"qpos": ("x", "y", "z", "qw", "qx", "qy", "qz"), "qvel": ("vx", "vy", "vz", "wx", "wy", "wz")}
# What can be mounted on a system's site "mark": the sensors of a set, and 1 sd of each one's noise.
SENSORS = {
    "imu": {'<gyro name="gyro" site="mark"/>': 0.02, '<accelerometer name="accelerometer" site="mark"/>': 0.1},
    "tracker": {'<framepos name="tracker" objtype="site" objname="mark"/>': 1e-3},
}
_DOF_FIELDS = ("damping", "armature", "frictionloss")


@dataclass(frozen=True)
class Psi:
    """An uncertain parameter: the model field that it sets and its prior, with NumPyro's names."""

    name: str
    target: str
    prior: str
    arguments: dict[str, float]
    index: int | None = None

    def draw(self, rng: np.random.Generator, sd: float | None = None, around: float | None = None) -> float:
        """One value from the prior, or from a narrower normal around a value, cut off where the prior ends."""
        a = self.arguments
        if around is not None and sd is not None:
            low, high = self.support()
            return float(np.clip(rng.normal(around, sd), 1.05 * low, 0.95 * high))
        if self.prior == "LogNormal":
            return float(np.exp(rng.normal(a["loc"], a["scale"])))
        low, high = ((a[key] - a["loc"]) / a["scale"] for key in ("low", "high"))
        uniform = rng.uniform(stats.norm.cdf(low), stats.norm.cdf(high))
        return float(a["loc"] + a["scale"] * stats.norm.ppf(uniform))

    def support(self) -> tuple[float, float]:
        """The range that a refit may use."""
        if self.prior == "LogNormal":
            return 1e-6, float(np.exp(self.arguments["loc"] + 6.0 * self.arguments["scale"]))
        return self.arguments["low"], self.arguments["high"]

    def sd(self) -> float:
        """The prior's standard deviation, to first order."""
        a = self.arguments
        return a["scale"] * (np.exp(a["loc"]) if self.prior == "LogNormal" else 1.0)

    def write(self, model: mujoco.MjModel, value: float) -> None:
        """Set that field alone; the caller recomputes derived constants (mj_setConst)."""
        write_field(model, self.target, value, self.index)


def write_field(model: mujoco.MjModel, target: str, value: float, index: int | None = None) -> None:
    """Set kind/name/field, or opt/field, of a model to a value."""
    kind, *middle, field = target.split("/")
    if kind == "opt":
        entry = getattr(model.opt, field)
        if index is None:
            setattr(model.opt, field, value)
        else:
            entry[index] = value
        return
    row = slice(None) if middle[0] == "*" else getattr(model, kind)(middle[0]).id
    if kind == "joint" and field in _DOF_FIELDS:
        row, array = model.jnt_dofadr[row], getattr(model, f"dof_{field}")
    else:
        array = getattr(model, f"{'jnt' if kind == 'joint' else kind}_{field}")
    array[row if index is None else (row, index)] = value


@lru_cache(maxsize=32)
def _compiled(xml: str) -> mujoco.MjModel:
    """Parsing costs more than a simulation; whoever writes to the model takes a copy."""
    return mujoco.MjModel.from_xml_string(xml)


def normal(name: str, target: str, loc: float, scale: float, index: int | None = None) -> Psi:
    """A normal prior, cut off at 0.3 and 1.7 times its centre."""
    arguments = {"loc": loc, "scale": scale, "low": round(0.3 * loc, 6), "high": round(1.7 * loc, 6)}
    return Psi(name, target, "TruncatedNormal", arguments, index)


def positive(name: str, target: str, loc: float, scale: float, index: int | None = None) -> Psi:
    """A log-normal prior with its median at exp(loc)."""
    return Psi(name, target, "LogNormal", {"loc": loc, "scale": scale}, index)


@dataclass(frozen=True)
class System:
    """A believed system; `start_*` and `reach` are per degree of freedom, `input_scale` per actuator.

    `noise_sd` gives 1 sd by column pattern, the first that fits; `measured` holds qpos, qvel and names of SENSORS.
    """

    name: str
    title: str
    body_xml: str  # without </mujoco>
    psi: tuple[Psi, ...]
    noise_sd: dict[str, float]
    start_position: tuple[float, ...]  # initial positions are uniform within +- of the model's own
    start_velocity: tuple[float, ...]
    reach: tuple[float, ...]  # recordings that go further from the model's own position are drawn again
    sampling: tuple[float, ...]  # possible sampling intervals [s]
    input_scale: tuple[float, ...] = ()
    mean_velocity: tuple[float, ...] = ()  # centre of the initial velocities; nothing: zero
    known: str = ""  # a field that somebody may have measured for each recording
    timestep: float = 0.005
    integrator: str = "RK4"
    medium: str = ""  # further attributes of <option>
    measured: tuple[str, ...] = ("qpos", "qvel")
    touching: bool = False  # bodies touch: sizes are taken over short stretches
    samples: int = 300  # of a recording, unless something else is asked for

    def measuring(self, *what: str) -> "System":
        """This system with these columns measured."""
        return replace(self, measured=what)

    def xml(self, timestep: float | None = None, integrator: str | None = None) -> str:
        """The MJCF, with another timestep or integrator if given."""
        step = f"{self.timestep if timestep is None else timestep:g}"
        header = HEADER.format(
            title=self.title, timestep=step, integrator=integrator or self.integrator, medium=self.medium
        )
        mounted = [line for name in self.measured for line in SENSORS.get(name, ())]
        sensors = "".join(["  <sensor>\n", *(f"    {line}\n" for line in mounted), "  </sensor>\n"]) if mounted else ""
        return f"{header}{self.body_xml}{sensors}</mujoco>\n"

    def compile(
        self,
        psi: dict[str, float],
        timestep: float | None = None,
        integrator: str | None = None,
        *,
        general: bool = False,
    ) -> mujoco.MjModel:
        """The compiled model at these parameters; a key with slashes is a field of the model.

        `general`: centres of mass and inertias may be moved afterwards, which MuJoCo forbids for simple bodies.
        """
        xml = self.xml(timestep, integrator)
        model = copy(_compiled(xml.replace("<body name", '<body simple="false" name') if general else xml))
        for entry in self.psi:
            if entry.name in psi:
                entry.write(model, psi[entry.name])
        for target, value in psi.items():
            if "/" in target:
                write_field(model, target, value)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def columns(self) -> list[str]:
        """The measured columns, in the order of `measured`."""
        model = _compiled(self.xml())
        result = []
        for kind in (kind for kind in ("qpos", "qvel") if kind in self.measured):
            for index in range(model.njnt):
                joint, free = model.joint(index).name, model.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE
                result += [f"{kind}/{joint}/{part}" for part in FREE_PARTS[kind]] if free else [f"{kind}/{joint}"]
        for index in range(model.nsensor):
            result += [f"sensor/{model.sensor(index).name}/{i}" for i in range(model.sensor_dim[index])]
        return result

    def noise(self) -> np.ndarray:
        """One standard deviation per measured column."""
        mounted = {
            f"sensor/{line.split('name=')[1].split(chr(34))[1]}/*": sd
            for kind in self.measured
            for line, sd in SENSORS.get(kind, {}).items()
        }
        patterns = self.noise_sd | mounted
        return np.array([next(sd for p, sd in patterns.items() if fnmatchcase(c, p)) for c in self.columns()])

    def draw_psi(self, rng: np.random.Generator) -> dict[str, float]:
        """Reality's parameters, from the prior."""
        return {entry.name: entry.draw(rng) for entry in self.psi}

    def draw_start(self, rng: np.random.Generator) -> np.ndarray:
        """An initial state: qpos, then qvel."""
        model = _compiled(self.xml())
        qpos = model.qpos0.copy()
        mujoco.mj_integratePos(model, qpos, np.array(self.start_position) * rng.uniform(-1.0, 1.0, model.nv), 1.0)
        qvel = np.array(self.start_velocity) * rng.uniform(-1.0, 1.0, model.nv)
        return np.concatenate((qpos, qvel + (np.array(self.mean_velocity) if self.mean_velocity else 0.0)))

    def draw_inputs(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        """Controls at `times`: sines plus random steps; one recording in five is nearly free."""
        level = 0.15 if rng.uniform() < 0.2 else rng.uniform(0.5, 1.0)
        inputs = np.zeros((times.size, len(self.input_scale)))
        for column, scale in enumerate(self.input_scale):
            for _ in range(4):
                frequency = np.exp(rng.uniform(np.log(0.2), np.log(3.0)))
                sine = np.sin(2.0 * np.pi * frequency * times + rng.uniform(-np.pi, np.pi))
                inputs[:, column] += rng.uniform(0.2, 0.5) * sine
            edges = np.cumsum(rng.uniform(0.2, 0.9, 40))
            heights = rng.uniform(0.1, 0.8, edges.size) * (-1.0) ** np.arange(edges.size)
            inputs[:, column] += heights[np.minimum(np.searchsorted(edges, times), edges.size - 1)]
            inputs[:, column] *= level * scale
        return inputs
