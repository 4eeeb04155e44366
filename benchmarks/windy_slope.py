"""Windy Slope's windowed likelihood by MJX and by the C engine, on the model that both can simulate, and on the scene.

MJX has no box against a cylinder, and its derivatives want a pyramidal cone: the prism in the post's place with that
cone is simulated by both. The scene itself, cylinder and elliptic cone, is the C engine's alone: what differs there is
told apart. Each likelihood is made of simulations under the same psi. Lines go to benchmarks/results/windy_slope.jsonl.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Float
from logs import append

from det2stoc_bayes.blind.proof import revision
from det2stoc_bayes.models import windy_slope, windy_slope_mjx
from det2stoc_bayes.models._response import Response

LOG = Path(__file__).parent / "results" / "windy_slope.jsonl"
DEGREE = 4  # of the response to psi about reality
AROUND = 3.0  # sds of reality's population: where psi are drawn
STEPS = windy_slope.HORIZONS[-1]
NUM_POINTS = 200  # psi at which likelihoods are compared, for each recording

type See = Callable[[Float[np.ndarray, "sims 3"]], Float[np.ndarray, "sims features"]]


@contextmanager
def model_of(model: mujoco.MjModel) -> Iterator[None]:
    """Both engines' modules simulate this model."""
    kept = windy_slope.load_model, windy_slope_mjx.prism_model
    windy_slope.load_model = windy_slope_mjx.prism_model = lambda *_: model
    try:
        yield
    finally:
        windy_slope.load_model, windy_slope_mjx.prism_model = kept


def seen_by(see: See, psi: Float[np.ndarray, "sims 3"]) -> tuple[Float[np.ndarray, "sims features"], float]:
    """Windows, and the seconds that they took."""
    began = time.perf_counter()
    found = see(psi)
    return found, time.perf_counter() - began


def compared(num_simulated: int) -> dict[str, Any]:
    """Windows, likelihoods and the psi that each likelihood finds, MJX and the scene against C on the shared model."""
    random, problem = np.random.default_rng(0), windy_slope.PROBLEM
    loc, scale = (np.array(a) for a in (windy_slope.REALITY.loc, windy_slope.REALITY.scale))
    box = loc - AROUND * scale, loc + AROUND * scale
    psi = random.uniform(*box, (num_simulated, 3))
    shared = windy_slope_mjx.prism_model()
    shared.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    by_c: See = lambda p: windy_slope.windows(windy_slope.simulate(p, num_steps=STEPS))  # noqa: E731
    by_mjx: See = lambda p: windy_slope.windows(windy_slope_mjx.simulate(p, num_steps=STEPS))  # noqa: E731
    with model_of(shared), jax.enable_x64(True):
        ways = {"c": seen_by(by_c, psi), "mjx": seen_by(by_mjx, psi)}
        x = by_c(problem.truth)
    ways["scene"] = seen_by(by_c, psi)
    x = x + problem.noise * random.standard_normal(x.shape)
    near = problem.truth[:, None] + random.standard_normal((len(x), NUM_POINTS, 3)) * np.array([0.0006, 0.012, 0.006])
    near = np.clip(near, *box)
    heights, peaks = {}, {}
    for name, (seen, _) in ways.items():
        response = Response.of(psi, seen, problem.noise, box, DEGREE)
        there = np.repeat(response.components(x), NUM_POINTS, 0)
        height = response.log_density(near.reshape(-1, 3), there).reshape(len(x), -1)
        heights[name] = height - height.mean(1, keepdims=True)  # what constants are is of no use to psi
        weight = np.exp(height - height.max(1, keepdims=True))
        peaks[name] = np.einsum("rp,rpk->rk", weight / weight.sum(1, keepdims=True), near)
    sd = np.array([0.0006, 0.012, 0.006])
    out: dict[str, Any] = {"simulated": num_simulated, "seconds": {n: round(s, 1) for n, (_, s) in ways.items()}}
    for name in ("mjx", "scene"):
        apart = (ways[name][0] - ways["c"][0]) / problem.noise
        out[name] = {
            "windows_apart_median_noise_sd": float(np.median(np.abs(apart))),
            "windows_apart_rms_noise_sd": float(np.sqrt(np.mean(apart**2))),
            "windows_equal_share": float((np.abs(apart).max(1) < 0.1).mean()),
            "log_likelihood_apart_rms_nat": float(np.sqrt(np.mean((heights[name] - heights["c"]) ** 2))),
            "psi_apart_largest_proposal_sd": float(np.abs((peaks[name] - peaks["c"]) / sd).max()),
        }
    return out


def main() -> int:
    """One line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-simulated", type=int, default=512)
    line = compared(parser.parse_args().num_simulated)
    append(LOG, {"commit": revision()} | line)
    print(line)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
