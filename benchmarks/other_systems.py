"""Systems of kinds that the concealed proof does not draw: a drone, a ball joint, a finger moved by a tendon, a marble.

Reality is each scene at a quarter of the timestep, with a law of its own and measurement noise. The study is diagnosed
by a process that sees nothing else. Results go to benchmarks/results/other_systems.jsonl.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from detective import FILES, FREE_Q, FREE_V, Case, conceal, write
from jaxtyping import Float

LOG = Path(__file__).parent / "results" / "other_systems.jsonl"
FINER = 4  # steps of reality for one of the model
PERIOD, FITTED, HELD = 0.01, 6, 2
NOISE_Q, NOISE_V = 5e-4, 5e-3
BALL_Q, BALL_V = ("qw", "qx", "qy", "qz"), ("wx", "wy", "wz")
DRAG, GAIN, TILT, MASS, PLACE, CUBIC, ROLLING = 0.15, 0.9, 0.03, 0.05, (0.05, 0.06, -0.3), 0.25, 0.003

DRONE = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>
  <body name="drone" pos="0 0 1"><freejoint name="fly"/><geom name="hull" type="box" size="0.1 0.1 0.03" mass="0.8"/>
    <site name="m1" pos="0.12 0.12 0"/><site name="m2" pos="-0.12 0.12 0"/>
    <site name="m3" pos="-0.12 -0.12 0"/><site name="m4" pos="0.12 -0.12 0"/></body></worldbody>
  <actuator><motor name="t1" site="m1" gear="0 0 1 0 0 0.02"/><motor name="t2" site="m2" gear="0 0 1 0 0 -0.02"/>
    <motor name="t3" site="m3" gear="0 0 1 0 0 0.02"/><motor name="t4" site="m4" gear="0 0 1 0 0 -0.02"/></actuator>
</mujoco>"""
BALL = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="bob" pos="0 0 2"><joint name="socket" type="ball" damping="0.01"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0.1 0 -0.5" size="0.01" mass="0.1"/>
    <geom name="weight" type="sphere" pos="0.1 0 -0.5" size="0.05" mass="0.4"/></body></worldbody></mujoco>"""
FINGER = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="near" pos="0 0 1"><joint name="mcp" type="hinge" axis="0 1 0" damping="0.01" stiffness="0.2"/>
    <geom type="capsule" fromto="0 0 0 0.12 0 0" size="0.012" mass="0.12"/>
    <body name="far" pos="0.12 0 0"><joint name="pip" type="hinge" axis="0 1 0" damping="0.006" stiffness="0.15"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.08"/></body></body></worldbody>
  <tendon><fixed name="flexor"><joint joint="mcp" coef="0.02"/><joint joint="pip" coef="0.014"/></fixed></tendon>
  <actuator><position name="servo" tendon="flexor" kp="900" kv="6"/></actuator></mujoco>"""
MARBLE = """<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1" friction="0.6 0.005 0.0001" condim="6"/>
  <body name="marble" pos="0 0 0.0499"><freejoint name="free"/>
    <geom name="skin" type="sphere" size="0.05" mass="0.3" condim="6" friction="0.6 0.005 0.0001"/></body></worldbody>
</mujoco>"""
type Random = np.random.Generator
type Command = Callable[[Random], Callable[[float], Float[np.ndarray, " controls"]]]
type Prepare = Callable[[mujoco.MjModel], Callable[[mujoco.MjData], None]]


def truncated(name: str, target: str, loc: float, scale: float, index: str = "") -> str:
    """A psi of the study, within 0.3 and 1.7 times its prior's middle."""
    prior = f"{{ TruncatedNormal = {{ loc = {loc}, scale = {scale}, low = {0.3 * loc:g}, high = {1.7 * loc:g} }} }}"
    return f'[psi.{name}]\ntarget = "{target}"\n{index}prior = {prior}\n'


@dataclass(frozen=True)
class Scene:
    """A model, how its recordings begin, what is commanded, and what is uncertain."""

    xml: str
    columns: tuple[str, ...]
    seconds: float
    begin: Callable[[mujoco.MjData, Random], None]
    psi: str
    command: Command = lambda _: lambda _t: np.zeros(0)
    integrator: mujoco.mjtIntegrator = mujoco.mjtIntegrator.mjINT_RK4  # of reality


def swaying(count: int, middle: float, amplitude: float) -> Command:
    """Commands that are sums of sines about a middle."""

    def drawn(random: Random) -> Callable[[float], Float[np.ndarray, " controls"]]:
        size = amplitude * random.uniform(0.4, 1.0, (count, 3)) / 1.7
        frequency, phase = random.uniform(0.3, 2.5, (count, 3)), random.uniform(0.0, 6.28, (count, 3))
        return lambda t: middle + (size * np.sin(2 * np.pi * frequency * t + phase)).sum(1)

    return drawn


def thrown(data: mujoco.MjData, random: Random) -> None:
    """A drone in flight."""
    data.qvel[:3], data.qvel[3:] = random.normal(0.0, 1.5, 3), random.normal(0.0, 0.5, 3)


def swung(data: mujoco.MjData, random: Random) -> None:
    """A pendulum turned to some side."""
    axis = random.normal(size=3)
    mujoco.mju_axisAngle2Quat(data.qpos, axis / np.linalg.norm(axis), random.uniform(0.4, 1.0))
    data.qvel[:] = random.normal(0.0, 1.5, 3)


def bent(data: mujoco.MjData, random: Random) -> None:
    """A finger a little bent."""
    data.qpos[:] = random.normal(0.0, 0.2, 2)


def rolling(data: mujoco.MjData, random: Random) -> None:
    """A marble that slides and spins."""
    turn = random.normal(size=4)
    data.qpos[3:] = turn / np.linalg.norm(turn)
    data.qvel[:2], data.qvel[3:] = random.normal(0.0, 1.0, 2), random.normal(0.0, 8.0, 3)


def free(joint: str) -> tuple[str, ...]:
    """Columns of a free joint."""
    return (*(f"qpos/{joint}/{c}" for c in FREE_Q), *(f"qvel/{joint}/{c}" for c in FREE_V))


SOCKET = (*(f"qpos/socket/{c}" for c in BALL_Q), *(f"qvel/socket/{c}" for c in BALL_V))
PLAIN = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
SCENES = {
    "drone": Scene(
        DRONE, (*free("fly"), *(f"ctrl/t{k}" for k in range(1, 5))), 1.5, thrown,
        truncated("mass", "body/drone/mass", 0.8, 0.1), swaying(4, 1.96, 0.25),
    ),
    "ball": Scene(BALL, SOCKET, 3.0, swung, truncated("damping", "joint/socket/damping", 0.01, 0.003)),
    "finger": Scene(
        FINGER, ("qpos/mcp", "qpos/pip", "qvel/mcp", "qvel/pip", "ctrl/servo"), 2.0, bent,
        truncated("stiffness", "joint/pip/stiffness", 0.15, 0.03), swaying(1, 0.0, 0.015),
    ),
    "marble": Scene(
        MARBLE, free("free"), 1.5, rolling, truncated("friction", "geom/*/friction", 0.6, 0.1, "index = [0]\n"),
        integrator=PLAIN,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Hidden:
    """What is concealed in a scene."""

    scene: str
    prepare: Prepare

    def __call__(self, model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
        """Changes a model; the forces to add to the passive ones."""
        return self.prepare(model)


def changing(change: Callable[[mujoco.MjModel], None]) -> Prepare:
    """A law that is a change of the model."""

    def prepare(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
        change(model)
        return lambda data: None

    return prepare


def dragged(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
    """Air that holds the drone back."""

    def push(data: mujoco.MjData) -> None:
        force, torque = -DRAG * data.qvel[:3], np.zeros(3)
        mujoco.mj_applyFT(model, data, force, torque, data.xipos[1], 1, data.qfrc_passive)

    return push


def hardened(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
    """A spring of the far joint that grows with the cube."""

    def push(data: mujoco.MjData) -> None:
        data.qfrc_passive[1] -= CUBIC * data.qpos[1] ** 3

    return push


def weak(model: mujoco.MjModel) -> None:
    """A motor of the drone that gives less."""
    model.actuator_gainprm[1, 0] *= GAIN


def tilted(model: mujoco.MjModel) -> None:
    """Gravity leans towards x."""
    model.opt.gravity[:] = 9.81 * np.array([np.sin(TILT), 0.0, -np.cos(TILT)])


def loaded(model: mujoco.MjModel) -> None:
    """A point mass in the bob."""
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[1])
    turn, mass, centre = frame.reshape(3, 3), model.body_mass[1], model.body_ipos[1].copy()
    both = (mass * centre + MASS * np.array(PLACE)) / (mass + MASS)
    inertia = turn @ np.diag(model.body_inertia[1]) @ turn.T
    for m, x in ((mass, centre), (MASS, np.array(PLACE))):
        d = x - both
        inertia = inertia + m * (d @ d * np.eye(3) - np.outer(d, d))
    values, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    mujoco.mju_mat2Quat(model.body_iquat[1], axes.ravel())
    model.body_inertia[1], model.body_ipos[1], model.body_mass[1] = values, both, mass + MASS
    model.body_sameframe[1] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    mujoco.mj_setConst(model, mujoco.MjData(model))


def sticky(model: mujoco.MjModel) -> None:
    """A floor on which rolling costs."""
    model.geom_friction[:, 2] = ROLLING


NOTHING = changing(lambda model: None)
CASES: dict[str, Case] = {
    "drone-drag": (Hidden("drone", dragged), "linear_drag", "drone"),
    "drone-gain": (Hidden("drone", changing(weak)), "actuator_gain", "t2"),
    "ball-tilt": (Hidden("ball", changing(tilted)), "gravity_tilt", "world"),
    "ball-payload": (Hidden("ball", changing(loaded)), "payload_mass", "bob"),
    "ball-nothing": (Hidden("ball", NOTHING), "", ""),
    "finger-cubic": (Hidden("finger", hardened), "cubic_stiffness", "pip"),
    "marble-rolling": (Hidden("marble", changing(sticky)), "rolling_friction", "floor/skin"),
    "marble-nothing": (Hidden("marble", NOTHING), "", ""),
}


def recorded(scene: Scene, law: Prepare, random: Random) -> Float[np.ndarray, "samples columns"]:
    """One recording with noise, time first."""
    model = mujoco.MjModel.from_xml_string(scene.xml)
    push = law(model)
    model.opt.timestep, model.opt.integrator = model.opt.timestep / FINER, scene.integrator
    data, command = mujoco.MjData(model), scene.command(random)
    scene.begin(data, random)
    rows = []
    mujoco.set_mjcb_passive(lambda _, at: push(at))  # at every stage of a step
    try:
        for t in PERIOD * np.arange(round(scene.seconds / PERIOD) + 1):
            data.ctrl[:] = command(float(t))
            rows.append(np.concatenate([[t], data.qpos, data.qvel, data.ctrl]))
            mujoco.mj_step(model, data, nstep=round(PERIOD / model.opt.timestep))
    finally:
        mujoco.set_mjcb_passive(None)
    values, q = np.array(rows), model.nq
    values[:, 1 : 1 + q] += NOISE_Q * random.standard_normal((len(rows), q))
    values[:, 1 + q : 1 + q + model.nv] += NOISE_V * random.standard_normal((len(rows), model.nv))
    return values


def make(folder: Path, law: Hidden, seed: int) -> Path:
    """A study of a scene in which something is concealed."""
    scene = SCENES[law.scene]
    streams = np.random.default_rng([seed, *map(ord, law.scene)]).spawn(FITTED + HELD)
    places = [*(f"recordings/rec_{k}" for k in range(FITTED)), *(f"holdout/hold_{k}" for k in range(HELD))]
    rows = {place: recorded(scene, law, random) for place, random in zip(places, streams, strict=True)}
    study = f'{FILES}\n{scene.psi}\n[noise]\n"qpos/*" = {NOISE_Q}\n"qvel/*" = {NOISE_V}\n'
    with tempfile.TemporaryDirectory() as place:
        model = Path(place) / "model.xml"
        model.write_text(scene.xml)
        return write(folder, model, study, scene.columns, rows)


if __name__ == "__main__":
    raise SystemExit(conceal(__doc__, CASES, list(CASES), LOG, make))
