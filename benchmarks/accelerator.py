"""MJX on jax's device, a GPU where there is one, beside the C engine on all cores, in one run.

Log densities of a whole problem a second, without and with gradients, by how many are asked for at once, and Windy
Slope's transitions. Lines go to benchmarks/results/accelerator.jsonl.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from joblib import cpu_count
from logs import append

from det2stoc_bayes.blind.proof import revision
from det2stoc_bayes.density_jax import batched_value_and_grad, mjx_terms
from det2stoc_bayes.inference._sampling import density_of
from det2stoc_bayes.models import get_problem, windy_slope, windy_slope_mjx

LOG = Path(__file__).parent / "results" / "accelerator.jsonl"
PROBLEMS = ("pendulum", "cartpole")
SIZES = (1, 64, 4096)
EPISODES = (64, 4096)
LEAST = 0.5  # seconds that one measurement lasts


def rate(work: Callable[[], Any], count: int) -> float:
    """How many a second; the first run, which may compile, does not count."""
    work()
    rounds, began = 0, time.perf_counter()
    while (took := time.perf_counter() - began) < LEAST or not rounds:
        work()
        rounds += 1
    return count * rounds / took


def densities(name: str) -> Iterator[dict[str, Any]]:
    """One problem in both engines, over points about its summit; how far their log densities are apart [nat]."""
    plain = density_of(get_problem(name, num_threads=0))
    density = density_of(get_problem(name, engine="mjx"))
    values, slopes = jax.jit(jax.vmap(mjx_terms(density))), batched_value_and_grad(density)
    random = np.random.default_rng(0).standard_normal((max(SIZES), density.size))
    points = density.center + random @ density.scale.T
    few = points[:64]
    apart = np.abs(np.asarray(values(jnp.asarray(few))) - plain.log_likelihood_by_recording(few)).max()
    for size in SIZES:
        z = points[:size]
        began = time.perf_counter()
        slopes(z)
        first = time.perf_counter() - began
        yield {
            "problem": name,
            "at once": size,
            "unit": "densities/s",
            "c": rate(lambda z=z: plain.log_likelihood_by_recording(z), size),
            "mjx": rate(lambda z=z: values(jnp.asarray(z)).block_until_ready(), size),
            "mjx and gradient": rate(lambda z=z: slopes(z), size),
            "seconds of a first call": first,
            "apart": float(apart),
        }


def transitions(count: int) -> dict[str, Any]:
    """Windy Slope's episodes in single precision, up to the hit and after it, beside the C engine's."""
    psi = windy_slope.PRIOR.draw(np.random.default_rng(0), count)
    began = time.perf_counter()
    with jax.enable_x64(False):
        windy_slope_mjx.simulate(psi)
        first = time.perf_counter() - began
        mjx = rate(lambda: windy_slope_mjx.simulate(psi), count * windy_slope.NUM_STEPS)
    return {
        "problem": "windy_slope",
        "at once": count,
        "unit": "transitions/s",
        "c": rate(lambda: windy_slope.simulate(psi), count * windy_slope.NUM_STEPS),
        "mjx": mjx,
        "seconds of a first call": first,
    }


def row(line: dict[str, Any]) -> str:
    """As Markdown."""
    fast = " | ".join(f"{line[k]:,.0f}" if k in line else "" for k in ("c", "mjx", "mjx and gradient"))
    return (
        f"| {line['problem']} | {line['at once']} | {line['unit']} | {fast} | {line['seconds of a first call']:.0f} |"
    )


def main() -> int:
    """Every problem and size once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", type=Path, default=LOG)
    given = parser.parse_args()
    about = {"commit": revision(), "device": jax.devices()[0].device_kind, "cores": cpu_count()}
    print(f"{about['device']} beside {about['cores']} cores")
    print(
        "| problem | at once | unit | C | MJX | MJX with gradient | s of a first call |\n|---|---|---|---|---|---|---|"
    )
    for line in chain(*map(densities, PROBLEMS), map(transitions, EPISODES)):
        append(given.log, about | line)
        print(row(line), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
