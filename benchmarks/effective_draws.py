"""Effective draws a second on cartpole: NUTS by MJX' exact gradients and by the C engine's, emcee; where time goes.

Gradients of the C engine are finite differences, or those of the mode's expansion (one simulation a point). Lines go to
benchmarks/results/effective_draws.jsonl.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from logs import append

from det2stoc_bayes.blind.proof import revision
from det2stoc_bayes.density import Density
from det2stoc_bayes.density_jax import batched_value_and_grad, mjx_terms
from det2stoc_bayes.inference import emcee, nuts
from det2stoc_bayes.inference._sampling import density_of
from det2stoc_bayes.models import get_problem
from det2stoc_bayes.report.summary import summarize

LOG = Path(__file__).parent / "results" / "effective_draws.jsonl"
WAYS: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "nuts, C, finite differences": ("c", nuts, {"gradient": "finite"}),
    "nuts, C, expansion": ("c", nuts, {"gradient": "expansion"}),
    "nuts, MJX": ("mjx", nuts, {}),
    "emcee, C": ("c", emcee, {}),
}
NUM_CHAINS, REPEATED = 4, 5
PARTS = ("compile", "mode", "gradients", "simulation", "rest")


class Watch:
    """Seconds by name; what runs within something else counts there alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inside = ""

    @contextmanager
    def over(self, owner: Any, attribute: str, name: str) -> Iterator[None]:
        """Time what an object's function takes."""
        plain: Callable[..., Any] = getattr(owner, attribute)

        def timed(*args: Any, **options: Any) -> Any:
            if self._inside == "mode" or self._inside == name:
                return plain(*args, **options)
            outer, began = self._inside, time.perf_counter()
            self._inside = name
            try:
                return plain(*args, **options)
            finally:
                took = time.perf_counter() - began
                self._inside = outer
                self.seconds[name] = self.seconds.get(name, 0.0) + took
                if outer:
                    self.seconds[outer] = self.seconds.get(outer, 0.0) - took

        setattr(owner, attribute, timed)
        try:
            yield
        finally:
            setattr(owner, attribute, plain)


def measured(way: str, num_samples: int, seed: int) -> dict[str, Any]:
    """One fit: effective draws of the worst psi, seconds in all and of each part."""
    engine, method, options = WAYS[way]
    problem = get_problem("cartpole", engine=engine, num_threads=1)
    watch = Watch()
    with ExitStack() as stack:
        stack.enter_context(watch.over(method, "mode_of", "mode"))
        stack.enter_context(watch.over(Density, "terms_and_grad", "gradients"))
        stack.enter_context(watch.over(problem.simulator.engine, "rollout", "simulation"))
        began = time.perf_counter()
        tree = method.fit(problem, seed, num_samples=num_samples, **options)
        seconds = time.perf_counter() - began
    parts = dict.fromkeys(PARTS, 0.0) | watch.seconds | {"compile": float(tree.attrs["seconds_compile"])}
    if engine == "mjx":
        steps = tree["sample_stats"]["n_steps"].values  # chains advance together, as many steps as the longest one
        batches = int(tree.attrs["gradients"]) * steps.max(0).sum() / steps.sum()
        within = _within_mjx(density_of(problem), batches)
        parts |= {"gradients": within["gradients"], "simulation": parts["simulation"] + within["simulation"]}
    parts["rest"] = seconds - sum(parts[p] for p in PARTS if p != "rest")
    ess = min(row.ess or 0.0 for row in summarize(tree))
    return {
        "way": way,
        "draws": num_samples,
        "ess": round(ess, 1),
        "seconds": round(seconds, 2),
        "ess_per_second": round(ess / seconds, 2),
        "simulations": int(tree.attrs["simulations"]),
        "gradients": int(tree.attrs["gradients"]),
        "parts": {p: round(parts[p], 2) for p in PARTS},
    }


def _within_mjx(density: Density, num_batches: float) -> dict[str, float]:
    """What so many gradients of all chains at once take, by the time of one: within a compiled step no clock runs."""
    z = density.center + 0.1 * np.random.default_rng(0).standard_normal((NUM_CHAINS, density.size)) @ density.scale.T
    plain = jax.jit(jax.vmap(mjx_terms(density)))
    value: Callable[[], Any] = lambda: plain(jnp.asarray(z)).block_until_ready()  # noqa: E731
    gradient: Callable[[], Any] = lambda: batched(z)  # noqa: E731
    batched = batched_value_and_grad(density)
    took = []
    for run in (value, gradient):
        run()
        began = time.perf_counter()
        for _ in range(REPEATED):
            run()
        took.append((time.perf_counter() - began) / REPEATED * num_batches)
    return {"simulation": took[0], "gradients": max(took[1] - took[0], 0.0)}


def row(line: dict[str, Any]) -> str:
    """As Markdown."""
    parts = " | ".join(f"{line['parts'][p]:.1f}" for p in PARTS)
    return f"| {line['way']} | {line['ess']:.0f} | {line['seconds']:.1f} | {line['ess_per_second']:.1f} | {parts} |"


def main() -> int:
    """Each way once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ways", nargs="*", help=f"of: {', '.join(WAYS)}; all unless told")
    parser.add_argument("--num-samples", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"| | ESS | s | ESS/s | {' | '.join(PARTS)} |\n|---|---|---|---|{'---|' * len(PARTS)}")
    if wrong := set(options.ways) - set(WAYS):
        parser.error(f"unknown ways {', '.join(sorted(wrong))}; allowed: {', '.join(WAYS)}")
    for way in options.ways or WAYS:
        line = measured(way, options.num_samples, options.seed)
        append(LOG, {"commit": revision()} | line)
        print(row(line), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
