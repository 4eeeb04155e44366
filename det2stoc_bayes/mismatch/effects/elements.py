"""Where effects sit, the magnitudes that scale their priors, and the states that their laws see."""

from dataclasses import dataclass
from typing import Any, Literal

Array = Any  # numpy or jax array
Kind = Literal["joint", "body", "actuator", "sensor", "world", "contact", "simulator"]


@dataclass(frozen=True)
class Element:
    """Something in the model that an effect can sit on; indices and traits are what hooks and candidates need.

    An actuator's dof and qpos are its joint's, if it drives one. `reach`: the least and the largest position of a joint
    that was recorded, its rest position if none was. `traits`: driven (a joint that motors drive, an actuator that
    drives a joint), held (a joint that a motor holds in a position), plain (an actuator of fixed or affine law), loose
    (a body whose inertial frame may be changed), sized (a body whose size a recording changes), fluid and wind (of the
    world), value and clock (of what is recorded), paired and free (of a contact that the model lists, with a free
    body).
    """

    kind: Kind
    name: str
    hinge: bool = False  # rotational: the second of two unit forms
    dof: int = -1
    qpos: int = -1
    body: int = -1
    ctrl: int = -1
    column: str = ""
    unit: str = ""  # of a sensor's column
    actuators: tuple[int, ...] = ()  # an actuator's own index, or those that drive a joint
    joint: int = -1
    source: str = ""  # the joint that a coupling holds to
    source_dof: int = -1
    source_qpos: int = -1
    reach: tuple[float, float] = (0.0, 0.0)
    geoms: tuple[int, int] = (-1, -1)  # of a contact; the second is the one that effects change
    geom_names: tuple[str, ...] = ()  # of these, where both have one
    pair: int = -1  # of a contact that the model lists
    traits: frozenset[str] = frozenset()

    @property
    def label(self) -> str:
        """Kind and name, as `joint wrist`."""
        return self.name if self.kind == self.name else f"{self.kind} {self.name}"


@dataclass(frozen=True)
class Typical:
    """Magnitudes in the believed model's own simulation, from which an effect's prior scales follow (SI units).

    force, speed, spin: root mean squares; span: half the range travelled, of a body its radius of gyration;
    peak_*: largest values; command: the largest command; of the world speed is the wind's and force gravity's.
    reach: the least and the largest position of a joint, as recorded.
    """

    force: float = 1.0
    speed: float = 1.0
    span: float = 1.0
    inertia: float = 1.0
    spin: float = 1.0
    peak_force: float = 2.0
    peak_speed: float = 2.0
    command: float = 1.0
    reach: tuple[float, float] = (-1.0, 1.0)
    density: float = 0.0  # of the fluid around a body
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of a body, in the middle
    way: float = 1.0  # m, root mean square distance of a body from there
    duration: float = 1.0  # s, the longest recording's
    sampling: float = 0.01  # s between samples
    timestep: float = 0.002
    integrator: str = "Euler"
    solref: tuple[float, float] = (0.02, 1.0)  # of a contact
    region: tuple[tuple[float, float, float], ...] = ()  # where a contact's body was: points of equal shares of time


@dataclass(frozen=True)
class Drive:
    """What the n actuators of one joint are given: their law's coefficients (..., n, 3), limits and inputs (..., n).

    `u` is a command or an activation; `least` and `most` bound the joint's whole torque (...).
    """

    gain: Array
    bias: Array
    gear: Array
    low: Array
    high: Array
    u: Array
    least: Array
    most: Array


@dataclass(frozen=True)
class JointState:
    """Position, speed and time of one joint, and what drives it.

    `source`: the joint that a coupling holds to; `anchor`: what a law with memory remembers.
    """

    q: Array
    v: Array
    t: Array
    drive: Drive | None = None
    source: "JointState | None" = None
    anchor: Array = None


@dataclass(frozen=True)
class BodyState:
    """World-frame velocity of a body's centre of mass (..., 3), angular velocity (..., 3), time, and its geoms.

    `shapes`: mjtGeom of each geom; `sizes` (..., geoms, 3). `position` (..., 3) of the centre of mass; mass and inertia
    (..., 3, 3) about it, along the world's axes.
    """

    velocity: Array
    t: Array
    spin: Array = 0.0
    shapes: tuple[int, ...] = ()
    sizes: Array = 0.0
    position: Array = 0.0
    mass: Array = 0.0
    inertia: Array = 0.0


def transmitted(drive, q, v, xp):
    """Torque of a joint's actuators (MuJoCo's fixed and affine laws, with their limits)."""
    length, speed = drive.gear * q[..., None], drive.gear * v[..., None]
    gain = drive.gain[..., 0] + drive.gain[..., 1] * length + drive.gain[..., 2] * speed
    bias = drive.bias[..., 0] + drive.bias[..., 1] * length + drive.bias[..., 2] * speed
    force = xp.clip(gain * drive.u + bias, drive.low, drive.high)
    return xp.clip(xp.sum(drive.gear * force, -1), drive.least, drive.most)
