"""Scenes of kinds that the concealed proof does not draw, their recordings' beginnings, commands and uncertain psi."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from detective import FREE_Q, FREE_V
from jaxtyping import Float

BALL_Q, BALL_V = ("qw", "qx", "qy", "qz"), ("wx", "wy", "wz")
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
CRANE = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="trolley" pos="0 0 3"><joint name="rail" type="slide" axis="1 0 0" damping="2"/>
    <geom type="box" size="0.1 0.1 0.05" mass="2"/>
    <body name="rope"><joint name="u1" type="hinge" axis="0 1 0" damping="0.002"/>
      <joint name="w1" type="hinge" axis="1 0 0" damping="0.002"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.8" size="0.01" mass="0.1"/>
      <body name="load" pos="0 0 -0.8"><joint name="u2" type="hinge" axis="0 1 0" damping="0.002"/>
        <joint name="w2" type="hinge" axis="1 0 0" damping="0.002"/>
        <geom type="box" pos="0 0 -0.3" size="0.1 0.15 0.2" mass="1.0"/></body></body></body></worldbody>
  <actuator><motor name="push" joint="rail"/></actuator></mujoco>"""
LINKAGE = """<mujoco><option timestep="0.001" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="crank" pos="0 0 1"><joint name="a" type="hinge" axis="0 1 0" damping="0.02"/>
    <geom type="capsule" fromto="0 0 0 0.15 0 0" size="0.012" mass="0.2"/>
    <body name="coupler" pos="0.15 0 0"><joint name="b" type="hinge" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0.25" size="0.012" mass="0.3"/></body></body>
  <body name="rocker" pos="0.4 0 1"><joint name="c" type="hinge" axis="0 1 0" damping="0.02"/>
    <geom type="capsule" fromto="0 0 0 -0.05 0 0.25" size="0.012" mass="0.3"/></body></worldbody>
  <equality><connect name="pin" body1="coupler" body2="rocker" anchor="0.2 0 0.25"/></equality>
  <actuator><motor name="drive" joint="a"/></actuator></mujoco>"""
WHEEL = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="rod" pos="0 0 1"><joint name="pivot" type="hinge" axis="0 1 0" damping="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.01" mass="0.2"/>
    <body name="wheel" pos="0 0 -0.3"><joint name="spin" type="hinge" axis="0 1 0" damping="0.0005"/>
      <geom type="cylinder" euler="90 0 0" size="0.08 0.01" mass="0.4"/></body></body></worldbody>
  <actuator><motor name="drive" joint="spin"/></actuator></mujoco>"""
BOUNCE = """<mujoco><option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
  <default><geom friction="0.5 0.005 0.0001" solref="-2000 -4"/></default><worldbody>
  <geom name="floor" type="plane" size="9 9 .1"/>
  <body name="ball" pos="0 0 0.6"><freejoint name="fly"/><geom name="skin" type="sphere" size="0.05" mass="0.2"/></body>
</worldbody></mujoco>"""
ROVER = """<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="9 9 .1" friction="0.8 0.005 0.0001"/>
  <body name="chassis" pos="0 0 0.06"><freejoint name="base"/>
    <geom name="deck" type="box" size="0.12 0.08 0.02" mass="1.5" contype="0" conaffinity="0"/>
    <geom name="caster" type="sphere" pos="-0.1 0 -0.04" size="0.02" mass="0.05" friction="0.01 0.005 0.0001"
      priority="1"/>
    <body name="wl" pos="0.05 0.1 0"><joint name="left" type="hinge" axis="0 1 0" damping="0.002"/>
      <geom name="tyre_l" type="cylinder" euler="90 0 0" size="0.06 0.012" mass="0.2"
        friction="0.01 0.005 0.0001"/></body>
    <body name="wr" pos="0.05 -0.1 0"><joint name="right" type="hinge" axis="0 1 0" damping="0.002"/>
      <geom name="tyre_r" type="cylinder" euler="90 0 0" size="0.06 0.012" mass="0.2"
        friction="0.01 0.005 0.0001"/></body></body></worldbody>
  <actuator><motor name="ml" joint="left"/><motor name="mr" joint="right"/></actuator></mujoco>"""
STOPS = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="upper" pos="0 0 1"><joint name="shoulder" type="hinge" axis="0 1 0" damping="0.03"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.015" mass="0.3"/>
    <body name="fore" pos="0 0 -0.3"><joint name="elbow" type="hinge" axis="0 1 0" damping="0.02" limited="true"
        range="-40 40"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.012" mass="0.2"/></body></body></worldbody>
  <actuator><motor name="drive" joint="shoulder"/></actuator></mujoco>"""
HOPPER = """<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <geom name="floor" type="plane" size="5 5 .1" friction="0.8 0.005 0.0001" contype="1" conaffinity="1"/>
  <body name="trunk" pos="0 0 0.5"><joint name="x" type="slide" axis="1 0 0"/>
    <joint name="z" type="slide" axis="0 0 1"/><geom type="box" size="0.1 0.05 0.05" mass="1.0"/>
    <body name="thigh" pos="0 0 -0.05"><joint name="hip" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.2"/>
      <body name="shank" pos="0 0 -0.2"><joint name="knee" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.012" mass="0.1"/>
        <geom name="foot" type="sphere" pos="0 0 -0.2" size="0.02" mass="0.05" friction="0.8 0.005 0.0001"
          contype="1" conaffinity="1"/></body></body></body></worldbody>
  <actuator><position name="hip_servo" joint="hip" kp="30" kv="1"/>
    <position name="knee_servo" joint="knee" kp="30" kv="1"/></actuator></mujoco>"""
PUSHER = """<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"/><worldbody>
  <geom name="table" type="plane" size="5 5 .1" friction="0.4 0.005 0.0001"/>
  <body name="block" pos="0.1 0 0.03"><freejoint name="free"/>
    <geom name="block" type="box" size="0.04 0.06 0.03" mass="0.3" friction="0.4 0.005 0.0001"/></body>
  <body name="pusher" pos="0 0 0.03"><joint name="push" type="slide" axis="1 0 0" damping="1"/>
    <geom name="tip" type="capsule" fromto="0 0 -0.02 0 0 0.02" size="0.01" mass="0.5" friction="0.3 0.005 0.0001"/>
  </body></worldbody><contact><exclude body1="world" body2="pusher"/></contact>
  <actuator><position name="servo" joint="push" kp="300" kv="20"/></actuator></mujoco>"""
type Random = np.random.Generator
type Command = Callable[[Random], Callable[[float], Float[np.ndarray, " controls"]]]


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


def free(joint: str, *others: str) -> tuple[str, ...]:
    """Columns of a free joint, and of hinges and slides beside it."""
    each = ("qpos", FREE_Q), ("qvel", FREE_V)
    return tuple(f"{kind}/{name}" for kind, of in each for name in (*(f"{joint}/{c}" for c in of), *others))


def hanging(data: mujoco.MjData, random: Random) -> None:
    """A crane's load that swings."""
    data.qpos[1:], data.qvel[:] = random.normal(0.0, 0.3, 4), random.normal(0.0, 0.5, 5)


def as_modelled(data: mujoco.MjData, random: Random) -> None:
    """At rest where the model has it."""


def spun(data: mujoco.MjData, random: Random) -> None:
    """A pendulum whose wheel turns."""
    data.qpos[0], data.qvel[:] = random.normal(0.0, 0.6), random.normal(0.0, [1.0, 5.0])


def dropped(data: mujoco.MjData, random: Random) -> None:
    """A ball that falls and spins."""
    data.qpos[2], data.qvel[:3] = random.uniform(0.3, 0.8), random.normal(0.0, 0.5, 3)
    data.qvel[3:] = random.normal(0.0, 6.0, 3)


def driving(data: mujoco.MjData, random: Random) -> None:
    """A rover that rolls."""
    data.qvel[:2], data.qvel[6:8] = random.normal(0.0, 0.2, 2), random.normal(0.0, 3.0, 2)


def crouched(data: mujoco.MjData, random: Random) -> None:
    """A hopper above the floor, its knee bent."""
    bend = random.uniform(0.4, 0.7)
    data.qpos[:] = 0.0, random.uniform(0.0, 0.1), bend, -2 * bend
    data.qvel[0] = random.normal(0.0, 0.3)


def hopping(random: Random) -> Callable[[float], Float[np.ndarray, " controls"]]:
    """Commands that bend and stretch a leg."""
    bend, (hip, knee) = random.uniform(0.5, 0.7), random.uniform(0.05, 0.25, 2)
    rate, phase = 2 * np.pi * random.uniform(1.0, 3.0), random.uniform(0.0, 6.28)
    return lambda t: np.array([bend, -2 * bend]) + np.array([hip, -knee]) * np.sin(rate * t + phase)


def before_it(data: mujoco.MjData, random: Random) -> None:
    """A block before a pusher, askew."""
    turn = random.uniform(-0.3, 0.3)
    place = random.uniform(0.07, 0.12), random.uniform(-0.03, 0.03), 0.03
    data.qpos[:7] = *place, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)


def advancing(random: Random) -> Callable[[float], Float[np.ndarray, " controls"]]:
    """A command that moves on and sways."""
    speed, rate = random.uniform(0.1, 0.3), random.uniform(2.0, 6.0)
    return lambda t: np.array([speed * t + 0.03 * np.sin(rate * t)])


def hinged(*joints: str) -> tuple[str, ...]:
    """Columns of hinges and slides."""
    return (*(f"qpos/{j}" for j in joints), *(f"qvel/{j}" for j in joints))


SOCKET = (*(f"qpos/socket/{c}" for c in BALL_Q), *(f"qvel/socket/{c}" for c in BALL_V))
PLAIN = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
SCENES = {
    "drone": Scene(
        DRONE, (*free("fly"), *(f"ctrl/t{k}" for k in range(1, 5))), 1.5, thrown,
        truncated("mass", "body/drone/mass", 0.8, 0.1), swaying(4, 1.96, 0.25),
    ),
    "ball": Scene(BALL, SOCKET, 3.0, swung, truncated("damping", "joint/socket/damping", 0.01, 0.003)),
    "finger": Scene(
        FINGER, (*hinged("mcp", "pip"), "ctrl/servo"), 2.0, bent,
        truncated("stiffness", "joint/pip/stiffness", 0.15, 0.03), swaying(1, 0.0, 0.015),
    ),
    "marble": Scene(
        MARBLE, free("free"), 1.5, rolling, truncated("friction", "geom/*/friction", 0.6, 0.1, "index = [0]\n"),
        integrator=PLAIN,
    ),
    "crane": Scene(
        CRANE, (*hinged("rail", "u1", "w1", "u2", "w2"), "ctrl/push"), 3.0, hanging,
        truncated("load_mass", "body/load/mass", 1.0, 0.15) + truncated("damping", "joint/rail/damping", 2.0, 0.4),
        swaying(1, 0.0, 12.0),
    ),
    "linkage": Scene(
        LINKAGE, (*hinged("a", "b", "c"), "ctrl/drive"), 2.0, as_modelled,
        truncated("damping", "joint/a/damping", 0.02, 0.006), swaying(1, 0.3, 0.8), PLAIN,
    ),
    "wheel": Scene(
        WHEEL, (*hinged("pivot", "spin"), "ctrl/drive"), 3.0, spun,
        truncated("damping", "joint/pivot/damping", 0.01, 0.003), swaying(1, 0.0, 0.25),
    ),
    "bounce": Scene(
        BOUNCE, free("fly"), 1.2, dropped, truncated("friction", "geom/*/friction", 0.5, 0.08, "index = [0]\n"),
        integrator=PLAIN,
    ),
    "rover": Scene(
        ROVER, (*free("base", "left", "right"), "ctrl/ml", "ctrl/mr"), 1.5, driving,
        truncated("friction", "geom/floor/friction", 0.8, 0.12, "index = [0]\n"), swaying(2, 0.02, 0.06), PLAIN,
    ),
    "stops": Scene(
        STOPS, (*hinged("shoulder", "elbow"), "ctrl/drive"), 3.0, bent,
        truncated("damping", "joint/elbow/damping", 0.02, 0.006), swaying(1, 0.0, 1.2),
    ),
    "hopper": Scene(
        HOPPER, (*hinged("x", "z", "hip", "knee"), "ctrl/hip_servo", "ctrl/knee_servo"), 2.0, crouched,
        truncated("friction", "geom/floor/friction", 0.8, 0.12, "index = [0]\n"), hopping, PLAIN,
    ),
    "pusher": Scene(
        PUSHER, (*free("free", "push"), "ctrl/servo"), 2.0, before_it,
        truncated("friction", "geom/table/friction", 0.4, 0.08, "index = [0]\n"), advancing, PLAIN,
    ),
}  # fmt: skip
