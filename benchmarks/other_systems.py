"""Systems of kinds that the concealed proof does not draw, from a drone and a ball joint to a crane and a rover.

Reality is each scene at a quarter of the timestep, with a law of its own and measurement noise. The study is diagnosed
by a process that sees nothing else. Results go to benchmarks/results/other_systems.jsonl.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from detective import FILES, Case, conceal, write
from jaxtyping import Float
from other_scenes import SCENES, Random, Scene

LOG = Path(__file__).parent / "results" / "other_systems.jsonl"
FINER = 4  # steps of reality for one of the model
PERIOD, FITTED, HELD = 0.01, 6, 2
NOISE_Q, NOISE_V = 5e-4, 5e-3
TILT, MASS, PLACE, ROLLING, SQUARE = 0.03, 0.05, (0.05, 0.06, -0.3), 0.003, 0.12  # rad, kg, m, m, kg/m
STEEP = 15.0  # 1/rad

type Prepare = Callable[[mujoco.MjModel], Callable[[mujoco.MjData], None]]


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


def dragging(coefficient: float) -> Prepare:
    """Air that holds a free body back, N s/m."""

    def prepare(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
        def push(data: mujoco.MjData) -> None:
            force, torque = -coefficient * data.qvel[:3], np.zeros(3)
            mujoco.mj_applyFT(model, data, force, torque, data.xipos[1], 1, data.qfrc_passive)

        return push

    return prepare


def hardening(joint: str, coefficient: float) -> Prepare:
    """A spring of a joint that grows with the cube, N m/rad3."""

    def prepare(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
        place, dof = model.joint(joint).qposadr[0], model.joint(joint).dofadr[0]

        def push(data: mujoco.MjData) -> None:
            data.qfrc_passive[dof] -= coefficient * data.qpos[place] ** 3

        return push

    return prepare


def stepping(joint: str, size: float, place: float) -> Prepare:
    """A torque that changes its sign within a few degrees: on no list, N m."""

    def prepare(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
        at, dof = model.joint(joint).qposadr[0], model.joint(joint).dofadr[0]

        def push(data: mujoco.MjData) -> None:
            data.qfrc_passive[dof] += size * np.tanh(STEEP * (data.qpos[at] - place))

        return push

    return prepare


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


def held_back(model: mujoco.MjModel) -> Callable[[mujoco.MjData], None]:
    """Air about a crane's load, by the square of its speed."""
    load = model.body("load").id

    def push(data: mujoco.MjData) -> None:
        speed, torque = np.zeros(6), np.zeros(3)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, load, speed, 0)
        force = -SQUARE * float(np.linalg.norm(speed[3:])) * speed[3:]
        mujoco.mj_applyFT(model, data, force, torque, data.xipos[load], load, data.qfrc_passive)

    return push


def rubbing(joint: str, friction: float) -> Prepare:
    """Dry friction of a joint."""

    def rub(model: mujoco.MjModel) -> None:
        model.dof_frictionloss[model.joint(joint).dofadr[0]] = friction

    return changing(rub)


def giving(actuator: str, share: float) -> Prepare:
    """A motor that gives a share of what it should."""

    def give(model: mujoco.MjModel) -> None:
        model.actuator_gainprm[model.actuator(actuator).id, 0] *= share

    return changing(give)


def clipped(actuator: str, limit: float) -> Prepare:
    """An actuator that takes commands up to a limit."""

    def clip(model: mujoco.MjModel) -> None:
        i = model.actuator(actuator).id
        model.actuator_ctrllimited[i], model.actuator_ctrlrange[i] = 1, (-limit, limit)

    return changing(clip)


NOTHING = changing(lambda model: None)
CASES: dict[str, Case] = {
    "drone-drag": (Hidden("drone", dragging(0.15)), "linear_drag", "drone"),
    "drone-gain": (Hidden("drone", giving("t2", 0.9)), "actuator_gain", "t2"),
    "ball-tilt": (Hidden("ball", changing(tilted)), "gravity_tilt", "world"),
    "ball-payload": (Hidden("ball", changing(loaded)), "payload_mass", "bob"),
    "ball-nothing": (Hidden("ball", NOTHING), "", ""),
    "finger-cubic": (Hidden("finger", hardening("pip", 0.25)), "cubic_stiffness", "pip"),
    "marble-rolling": (Hidden("marble", changing(sticky)), "rolling_friction", "floor/skin"),
    "marble-nothing": (Hidden("marble", NOTHING), "", ""),
    "crane-drag": (Hidden("crane", held_back), "quadratic_drag", "load"),
    "crane-friction": (Hidden("crane", rubbing("rail", 1.5)), "coulomb_friction", "rail"),
    "crane-nothing": (Hidden("crane", NOTHING), "", ""),
    "linkage-friction": (Hidden("linkage", rubbing("c", 0.06)), "coulomb_friction", "c"),
    "linkage-nothing": (Hidden("linkage", NOTHING), "", ""),
    "wheel-cubic": (Hidden("wheel", hardening("pivot", 0.15)), "cubic_stiffness", "pivot"),
    "wheel-gain": (Hidden("wheel", giving("drive", 0.9)), "actuator_gain", "drive"),
    "wheel-friction": (Hidden("wheel", rubbing("pivot", 0.02)), "coulomb_friction", "pivot"),
    "wheel-nothing": (Hidden("wheel", NOTHING), "", ""),
    "bounce-drag": (Hidden("bounce", dragging(0.06)), "linear_drag", "ball"),
    "bounce-nothing": (Hidden("bounce", NOTHING), "", ""),
    "rover-gain": (Hidden("rover", giving("mr", 0.8)), "actuator_gain", "mr"),
    "rover-nothing": (Hidden("rover", NOTHING), "", ""),
    "stops-nothing": (Hidden("stops", NOTHING), "", ""),
    "stops-friction": (Hidden("stops", rubbing("elbow", 0.02)), "coulomb_friction", "elbow"),
    "stops-cubic": (Hidden("stops", hardening("shoulder", 0.5)), "cubic_stiffness", "shoulder"),
    "hopper-saturation": (Hidden("hopper", clipped("knee_servo", 1.2)), "actuator_saturation", "knee_servo"),
    "hopper-step": (Hidden("hopper", stepping("hip", 1.5, 0.55)), "unlisted", "hip"),
    "hopper-nothing": (Hidden("hopper", NOTHING), "", ""),
    "pusher-tilt": (Hidden("pusher", changing(tilted)), "gravity_tilt", "world"),
    "pusher-nothing": (Hidden("pusher", NOTHING), "", ""),
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
    # Reality's steps are other ones than the believed.
    raise SystemExit(conceal(__doc__, CASES, list(CASES), LOG, make, aside=["numerical_integration"]))
