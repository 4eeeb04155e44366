"""How often YuMi Pusher's box comes to the goal, over psi_0 and random starts, and how long that takes to simulate.

python benchmarks/yumi_pusher.py [EPISODES]
"""

import sys
import time

import numpy as np

from det2stoc_bayes.models import yumi_pusher
from det2stoc_bayes.models.yumi_pusher_policy import Pusher

LEAST, LONGEST = 0.8, 600.0  # share at the goal; s for 200,000 transitions


def main() -> int:
    """Share, and time for 200,000 transitions."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    random = np.random.default_rng(0)
    psi, start = yumi_pusher.PRIOR.draw(random, count), yumi_pusher.drawn_starts(random, count)
    began = time.perf_counter()
    runs = yumi_pusher.simulate(psi, start, lambda _: Pusher(random), random)
    seconds = time.perf_counter() - began
    share, for_all = yumi_pusher.at_goal(runs.states).mean(), seconds * 2000 / count
    print(f"{share:.1%} of {count} episodes at the goal (allowed: {LEAST:.0%})")
    print(f"{seconds:.0f} s; 200,000 transitions: {for_all:.0f} s (allowed: {LONGEST:.0f})")
    return int(share < LEAST or for_all > LONGEST)


if __name__ == "__main__":
    raise SystemExit(main())
