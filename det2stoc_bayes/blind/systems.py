"""The believed systems: MJCF, uncertain parameters with priors, noise, and how experiments are drawn."""

from dataclasses import dataclass, field

import mujoco
import numpy as np
from scipy import stats

from det2stoc_bayes.blind.mechanisms import ARM, CART_POLE, HEADER, PENDULUM, SLIDER


@dataclass(frozen=True)
class Psi:
    """An uncertain parameter: the model field that it sets and its prior, with NumPyro's names."""

    name: str
    target: str
    prior: str
    arguments: dict[str, float]
    index: int | None = None

    def draw(self, rng: np.random.Generator) -> float:
        """One value from the prior."""
        a = self.arguments
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

    def write(self, model: mujoco.MjModel, value: float) -> None:
        """Set that field alone; the caller recomputes derived constants (mj_setConst)."""
        kind, name, attribute = self.target.split("/")
        if kind == "joint" and attribute == "damping":
            model.dof_damping[model.joint(name).dofadr[0]] = value
        elif kind == "joint":
            model.jnt_stiffness[model.joint(name).id] = value
        elif kind == "body":
            model.body_mass[model.body(name).id] = value
        else:
            model.actuator_gainprm[model.actuator(name).id, self.index] = value


def _normal(name: str, target: str, loc: float, scale: float, index: int | None = None) -> Psi:
    arguments = {"loc": loc, "scale": scale, "low": round(0.3 * loc, 4), "high": round(1.7 * loc, 4)}
    return Psi(name, target, "TruncatedNormal", arguments, index)


@dataclass(frozen=True)
class System:
    """A believed system; every per-joint tuple is in the order of `joints`, inputs of `actuators`."""

    name: str
    title: str
    body_xml: str
    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    actuators: tuple[str, ...]
    psi: tuple[Psi, ...]
    noise_position: tuple[float, ...]
    noise_velocity: tuple[float, ...]
    start_position: tuple[float, ...]  # initial positions are uniform within +-
    start_velocity: tuple[float, ...]
    reach: tuple[float, ...]  # recordings that leave +-reach are drawn again
    input_scale: tuple[float, ...]
    sampling: tuple[float, ...]  # possible sampling intervals [s]
    timestep: float = 0.005
    integrator: str = "RK4"
    absorbed: dict[tuple[str, str], str] = field(default_factory=dict)  # (effect, element) -> why not

    def xml(self, timestep: float | None = None, integrator: str | None = None) -> str:
        """The MJCF, with another timestep or integrator if given."""
        step = f"{self.timestep if timestep is None else timestep:g}"
        header = HEADER.format(title=self.title, timestep=step, integrator=integrator or self.integrator)
        return header + self.body_xml

    def compile(
        self, psi: dict[str, float], timestep: float | None = None, integrator: str | None = None
    ) -> mujoco.MjModel:
        """The compiled model at these parameters."""
        model = mujoco.MjModel.from_xml_string(self.xml(timestep, integrator))
        for entry in self.psi:
            entry.write(model, psi[entry.name])
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def columns(self) -> list[str]:
        """The measured columns, positions first."""
        return [f"{kind}/{joint}" for kind in ("qpos", "qvel") for joint in self.joints]

    def noise(self) -> np.ndarray:
        """One standard deviation per measured column."""
        return np.array(self.noise_position + self.noise_velocity)

    def draw_psi(self, rng: np.random.Generator) -> dict[str, float]:
        """Reality's parameters, from the prior."""
        return {entry.name: entry.draw(rng) for entry in self.psi}

    def draw_start(self, rng: np.random.Generator) -> np.ndarray:
        """An initial state: positions, then velocities."""
        spread = np.array(self.start_position + self.start_velocity)
        return spread * rng.uniform(-1.0, 1.0, spread.size)

    def draw_inputs(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        """Controls at `times`: sines plus random steps; one recording in five is nearly free."""
        level = 0.15 if rng.uniform() < 0.2 else rng.uniform(0.5, 1.0)
        inputs = np.zeros((times.size, len(self.actuators)))
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


SYSTEMS: dict[str, System] = {
    system.name: system
    for system in (
        System(
            name="cart_pole",
            title="cart with a hanging pole",
            body_xml=CART_POLE,
            joints=("track", "swing"),
            bodies=("cart", "pole"),
            actuators=("push",),
            psi=(
                _normal("cart_mass", "body/cart/mass", 1.0, 0.15),
                Psi("pole_damping", "joint/swing/damping", "LogNormal", {"loc": -3.9, "scale": 0.3}),
                _normal("push_gain", "actuator/push/gainprm", 1.0, 0.1, 0),
            ),
            noise_position=(1e-3, 2e-3),
            noise_velocity=(1e-2, 2e-2),
            start_position=(0.5, 1.2),
            start_velocity=(0.8, 2.0),
            reach=(3.0, 2.4),
            input_scale=(7.0,),
            sampling=(0.01, 0.015, 0.02),
            absorbed={
                ("viscous_damping", "swing"): "is psi pole_damping",
                ("armature", "track"): "cart_mass and push_gain absorb it: the cart only slides",
                ("actuator_gain", "push"): "is psi push_gain",
                ("sensor_bias", "qpos/track"): "nothing depends on where the cart is",
            },
        ),
        System(
            name="pendulum",
            title="driven pendulum",
            body_xml=PENDULUM,
            joints=("pivot",),
            bodies=("rod",),
            actuators=("drive",),
            psi=(
                _normal("rod_mass", "body/rod/mass", 1.0, 0.15),
                _normal("pivot_damping", "joint/pivot/damping", 0.06, 0.015),
                _normal("drive_gain", "actuator/drive/gainprm", 1.0, 0.1, 0),
            ),
            noise_position=(2e-3,),
            noise_velocity=(2e-2,),
            start_position=(1.6,),
            start_velocity=(3.0,),
            reach=(2.5,),
            input_scale=(1.3,),
            sampling=(0.01, 0.015, 0.02),
            absorbed={
                ("viscous_damping", "pivot"): "is psi pivot_damping",
                ("joint_spring", "pivot"): "rod_mass takes up nearly all of it",
                ("armature", "pivot"): "gain, weight and damping over inertia are all of psi's",
                ("actuator_gain", "drive"): "is psi drive_gain",
            },
        ),
        System(
            name="arm",
            title="planar arm with two links",
            body_xml=ARM,
            joints=("shoulder", "elbow"),
            bodies=("upper_arm", "forearm"),
            actuators=("shoulder_motor", "elbow_motor"),
            psi=(
                _normal("forearm_mass", "body/forearm/mass", 0.9, 0.12),
                _normal("elbow_damping", "joint/elbow/damping", 0.25, 0.05),
                _normal("shoulder_gain", "actuator/shoulder_motor/gainprm", 1.0, 0.1, 0),
            ),
            noise_position=(2e-3, 2e-3),
            noise_velocity=(2e-2, 2e-2),
            start_position=(0.9, 0.9),
            start_velocity=(1.5, 1.5),
            reach=(2.0, 2.4),
            input_scale=(4.0, 1.5),
            sampling=(0.01, 0.015, 0.02),
            absorbed={
                ("viscous_damping", "elbow"): "is psi elbow_damping",
                ("actuator_gain", "shoulder_motor"): "is psi shoulder_gain",
            },
        ),
        System(
            name="slider",
            title="carriage on a sprung rail",
            body_xml=SLIDER,
            joints=("rail",),
            bodies=("carriage",),
            actuators=("coil",),
            psi=(
                _normal("carriage_mass", "body/carriage/mass", 2.0, 0.3),
                _normal("rail_stiffness", "joint/rail/stiffness", 60.0, 9.0),
                _normal("rail_damping", "joint/rail/damping", 2.0, 0.4),
            ),
            noise_position=(1e-3,),
            noise_velocity=(1e-2,),
            start_position=(0.3,),
            start_velocity=(1.0,),
            reach=(1.0,),
            input_scale=(15.0,),
            sampling=(0.01, 0.015, 0.02),
            absorbed={
                ("viscous_damping", "rail"): "is psi rail_damping",
                ("joint_spring", "rail"): "is psi rail_stiffness",
                ("armature", "rail"): "is psi carriage_mass",
                ("actuator_gain", "coil"): "mass, stiffness and damping scale it away",
            },
        ),
    )
}
