"""One robot pushes YuMi Pusher's box by mink's inverse kinematics, which knows joints' ranges and top speeds.

The batched pusher solves damped least squares without them; where no limit is reached both say the same.

python benchmarks/yumi_ik.py [EPISODES]    (`make ik` installs mink)
"""

import sys
import time
from dataclasses import dataclass, field

import mink  # pyright: ignore[reportMissingImports]  # of the group `ik`
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.models import yumi_pusher
from det2stoc_bayes.models.yumi_pusher_policy import DAMPING, FASTEST, HOMING, LENGTH, PERIOD, Pusher

SOLVER = "daqp"
LEAST = 0.75  # share of episodes at the goal
ALIKE = 0.01  # rad/s: median distance from damped least squares


class Inverse:
    """Joint speeds of one arm as mink's quadratic programme: the hand's velocity, near home, within limits."""

    def __init__(self):
        model = yumi_pusher.load_model()
        self.now = mink.Configuration(model, model.qpos0)
        self.hands = [mink.FrameTask(f"{side}_tip", "site", 1.0, LENGTH) for side in yumi_pusher.SIDES]
        cost = np.r_[np.zeros(6), np.full(14, DAMPING)]  # the box is no joint
        self.posture = mink.PostureTask(model, cost, gain=HOMING * PERIOD)
        self.posture.set_target(np.r_[model.qpos0[:7], yumi_pusher.HOME, yumi_pusher.HOME * yumi_pusher.MIRROR])
        speeds = mink.VelocityLimit(model, dict.fromkeys(yumi_pusher.JOINTS, FASTEST[1]))
        self.limits = [mink.ConfigurationLimit(model), speeds]

    def __call__(
        self, arm: int, joints: Float[np.ndarray, " 14"], wanted: Float[np.ndarray, " 6"]
    ) -> Float[np.ndarray, " 7"]:
        """[rad/s] for a velocity of the hand [m/s, rad/s, world]."""
        self.now.update(np.r_[self.now.q[:7], joints])
        task, pose = self.hands[arm], self.now.get_transform_frame_to_world(f"{yumi_pusher.SIDES[arm]}_tip", "site")
        turn = mink.SO3.exp(PERIOD * wanted[3:]) @ pose.rotation()
        there = pose.translation() + PERIOD * wanted[:3]
        task.set_target(mink.SE3.from_rotation_and_translation(turn, there))
        found = mink.solve_ik(self.now, [task, self.posture], PERIOD, SOLVER, limits=self.limits)
        return found[6 + 7 * arm : 13 + 7 * arm]


@dataclass(eq=False)
class MinkPusher(Pusher):
    """The pusher with mink in the place of damped least squares; keeps how far apart they were [rad/s]."""

    inverse: Inverse = field(default_factory=Inverse)
    apart: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def joint_speeds(self, arm, state, jacobian, wanted, back):
        """Of each simulation in turn."""
        plain = super().joint_speeds(arm, state, jacobian, wanted, back)
        began = time.perf_counter()
        found = np.array([self.inverse(arm, s[:14], w) for s, w in zip(state, wanted, strict=True)]).reshape(-1, 7)
        self.seconds += time.perf_counter() - began
        self.apart += np.abs(found - plain).max(1).tolist()
        return found


def main() -> int:
    """Episodes at the goal, and how mink's commands differ from the batched pusher's."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    random = np.random.default_rng(0)
    psi, start = yumi_pusher.REALITY.draw(random, count), yumi_pusher.drawn_starts(random, count)
    pusher = MinkPusher(random)
    runs = yumi_pusher.simulate(psi, start, lambda _: pusher, random)
    share, apart = yumi_pusher.at_goal(runs.states).mean(), np.array(pusher.apart)
    print(f"{share:.0%} of {count} episodes at the goal (allowed: {LEAST:.0%})")
    middle = np.median(apart)
    print(f"from damped least squares: {middle:.2g} rad/s (median; allowed: {ALIKE}), at most {apart.max():.2g}")
    print(f"{1e3 * pusher.seconds / len(apart):.2f} ms a solution")
    return int(share < LEAST or middle > ALIKE)


if __name__ == "__main__":
    raise SystemExit(main())
