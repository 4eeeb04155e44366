"""Time of Windy Slope's transitions beside a bare loop over `mujoco.batch` on the same scene, taken in turn.

python benchmarks/transitions.py [--million]
"""

import argparse
import time

import numpy as np

from det2stoc_bayes.models import windy_slope
from det2stoc_bayes.transitions import Transitions

ROUNDS = 5
ALLOWED = 1.3


def bare(psi: np.ndarray) -> None:
    """Episodes stepped in the same chunks, with nothing recorded."""
    model = windy_slope.load_model()
    for begin in range(0, len(psi), windy_slope.CHUNK):
        batch = windy_slope.prepared(model, psi[begin : begin + windy_slope.CHUNK], 0)
        for _ in range(windy_slope.NUM_STEPS):
            batch.step(nstep=windy_slope.SUBSTEPS)


def whole(psi: np.ndarray) -> None:
    """What training takes: rows of state, action, change."""
    Transitions.of_episodes(windy_slope.simulate(psi))


def main() -> int:
    """A ratio of medians."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--million", action="store_true", help="one round of 10,000 episodes instead of five of 512")
    rounds, count = (1, 10_000) if parser.parse_args().million else (ROUNDS, windy_slope.CHUNK)
    psi = windy_slope.PRIOR.draw(np.random.default_rng(0), count)
    times: dict[str, list[float]] = {"bare": [], "whole": []}
    for _ in range(rounds):
        for name, work in (("bare", bare), ("whole", whole)):
            began = time.perf_counter()
            work(psi)
            times[name].append(time.perf_counter() - began)
    least = {name: float(np.median(t)) for name, t in times.items()}
    ratio = least["whole"] / least["bare"]
    rate = count * windy_slope.NUM_STEPS / least["whole"]
    print(f"{rate:,.0f} transitions/s; {ratio:.3f} of the time of the bare loop (allowed: {ALLOWED})")
    return int(ratio > ALLOWED)


if __name__ == "__main__":
    raise SystemExit(main())
