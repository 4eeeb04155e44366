"""How the robot pushes the box to the goal: closed loop, in strokes of random speed, with noise that explores.

The arm on whose side the box starts goes behind the box, its two fingers along the box's face, and pushes. It pushes
off the face's middle to turn the box to the goal. The other arm stays at home. Everything is seen through measured
states alone, for all simulations at once.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.models import yumi_pusher
from det2stoc_bayes.models._arm import damped_least_squares

PERIOD = 0.04
STROKE, REST = 12, 4  # steps of a stroke, the last of which the hand rests
SPEEDS = (0.18, 0.36)  # of strokes [m/s]
BEHIND = 0.06  # where the hand goes before it pushes [m]
TIP_HEIGHT = 0.106
TILT = 0.6  # of the hand, off straight down [rad]
OFFSET, OFF_MIDDLE = 0.2, 0.045  # m a radian that the goal is askew: where to push the face, and the farthest place
LEAD, MOST_LEAD = 0.7, 0.35  # by how much of that the fingers' line turns ahead of the face, and at most [rad]
REACTION, SQUARELY = 5.0, 3.0  # 1/s: of places, of turns
DAMPING, HOMING = 0.08, 0.5  # 1/s: pull to the posture at home
LENGTH = 0.15  # m: what a radian counts as
FASTEST = 0.35, 1.5  # m/s of the hand, rad/s of a joint
SLUGGISH = 0.85  # of the noise that explores: what is left of it a step later
NOISE_HAND, NOISE_JOINTS = np.array([0.02, 0.03, 0.3]), 0.02  # m/s, m/s, rad/s of the hand; rad/s of every joint


@dataclass(eq=False)
class Pusher:
    """Commands of simulations from their measured states, step by step."""

    random: np.random.Generator
    exploring: float = 1.0  # of the noise; 0: none
    _step: int = 0
    _arm: Int[np.ndarray, " sims"] = field(default_factory=lambda: np.zeros(0, int))  # 0: left, 1: right
    _noise: Float[np.ndarray, "sims 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    _speed: Float[np.ndarray, " sims"] = field(default_factory=lambda: np.zeros(0))

    def __call__(self, state: Float[np.ndarray, "sims 60"]) -> Float[np.ndarray, "sims 14"]:
        """Joint velocities [rad/s]."""
        count, random = len(state), self.random
        if self._step == 0:
            self._arm, self._noise = (state[:, 43] < 0).astype(int), np.zeros((count, 3))
        if self._step % STROKE == 0:
            self._speed = random.uniform(*SPEEDS, count)
        fresh = np.sqrt(1 - SLUGGISH**2) * NOISE_HAND * random.standard_normal((count, 3))
        self._noise = SLUGGISH * self._noise + self.exploring * fresh
        out = self.exploring * NOISE_JOINTS * random.standard_normal((count, 14))
        resting = self._step % STROKE >= STROKE - REST
        for i, arm in enumerate(yumi_pusher.arms()):
            joints, mine = slice(7 * i, 7 * i + 7), self._arm == i
            home = yumi_pusher.HOME * (yumi_pusher.MIRROR if i else 1.0)
            back = HOMING * (home - state[:, joints])
            out[~mine, joints] += back[~mine]
            place, turn, jacobian = arm.pose(state[mine, joints])
            wanted = _hand(state[mine], place, turn, 2 * i - 1, self._noise[mine], self._speed[mine] * (not resting))
            out[mine, joints] += self.joint_speeds(i, state[mine], jacobian, wanted, back[mine])
        self._step += 1
        return np.clip(out, -FASTEST[1], FASTEST[1])

    def joint_speeds(
        self,
        arm: int,
        state: Float[np.ndarray, "sims 60"],
        jacobian: Float[np.ndarray, "sims 6 7"],
        wanted: Float[np.ndarray, "sims 6"],
        back: Float[np.ndarray, "sims 7"],
    ) -> Float[np.ndarray, "sims 7"]:
        """Of an arm [rad/s] whose hand is to move as `wanted`, its joints, where that leaves them free, `back`."""
        weight = np.array([1, 1, 1, LENGTH, LENGTH, LENGTH])
        return damped_least_squares(jacobian * weight[:, None], wanted * weight, back, DAMPING)


def _hand(
    state: Float[np.ndarray, "sims 60"],
    place: Float[np.ndarray, "sims 3"],
    turn: Float[np.ndarray, "sims 3 3"],
    side: int,
    noise: Float[np.ndarray, "sims 3"],
    speed: Float[np.ndarray, " sims"],
) -> Float[np.ndarray, "sims 6"]:
    """Linear and angular velocity of a hand [m/s, rad/s], whose x points left (`side` 1) or right (-1)."""
    ahead, left = state[:, [45, 48]], state[:, [46, 49]]  # the box's x and y axes on the table
    to_goal, off = yumi_pusher.GOAL - state[:, 42:44], place[:, :2] - state[:, 42:44]
    far, lateral = (to_goal * ahead).sum(1), (to_goal * left).sum(1)
    askew = np.where(far > 0.03, np.arctan2(lateral, np.maximum(far, 0.03)), 0.0)  # the goal's direction, from the box
    along, across = (off * ahead).sum(1), (off * left).sum(1)
    middle = np.clip(-OFFSET * askew, -OFF_MIDDLE, OFF_MIDDLE)
    yaw = np.arctan2(-side * turn[:, 0, 0], side * turn[:, 1, 0])  # of the fingers' line against the table's y
    wrong = (np.arctan2(ahead[:, 1], ahead[:, 0]) - yaw + np.pi) % (2 * np.pi) - np.pi
    ready = np.exp(-(((across - middle) / 0.03) ** 2) - (wrong / 0.4) ** 2)
    near = along > -BEHIND - 0.01
    pushing = np.where(near, ready, 0.0)
    forward = REACTION * (-BEHIND - along) * (1 - pushing) + pushing * speed * np.clip(far / 0.03, 0.0, 1.0)
    sideways = REACTION * (middle - across)
    flat = (forward + noise[:, 0])[:, None] * ahead + (sideways + noise[:, 1])[:, None] * left
    flat *= np.minimum(1.0, FASTEST[0] / np.maximum(np.linalg.norm(flat, axis=1), 1e-9))[:, None]
    rise = REACTION * (TIP_HEIGHT - place[:, 2])
    lead = yaw + wrong + np.clip(LEAD * askew, -MOST_LEAD, MOST_LEAD) * pushing
    spin = SQUARELY * _between(turn, _pointing(lead, side))
    spin[:, 2] += noise[:, 2]
    return np.concatenate([flat, rise[:, None], spin], 1)


def _pointing(yaw: Float[np.ndarray, " sims"], side: int) -> Float[np.ndarray, "sims 3 3"]:
    """A hand that points ahead and down, lest its palm touch the box before its fingers do."""
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    x = side * np.stack([-s, c, zero], 1)
    z = np.stack([np.sin(TILT) * c, np.sin(TILT) * s, np.full(len(yaw), -np.cos(TILT))], 1)
    return np.stack([x, np.cross(z, x), z], 2)


def _between(turn: Float[np.ndarray, "sims 3 3"], wanted: Float[np.ndarray, "sims 3 3"]) -> Float[np.ndarray, "sims 3"]:
    """Rotation vectors that lead from one to the other, exact for small ones."""
    return 0.5 * np.cross(turn, wanted, axis=1).sum(2)
