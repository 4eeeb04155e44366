"""Amortized beside exact posteriors of the problems whose posterior can be known: `det2stoc compare`, on each.

Lines go to benchmarks/results/compare.jsonl, one a problem and method; reports to --out, where finished runs stay.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from logs import append

from det2stoc_bayes.blind.proof import revision

LOG = Path(__file__).parent / "results" / "compare.jsonl"
PROBLEMS = ("trivariate", "linear_gaussian", "pendulum", "cartpole", "windy_slope")
EXACT = ("nuts", "blackjax_nuts", "smc", "emcee")
OTHERS = ("prior", "laplace", "svi", "population_search", "npe", "npe+psis", "det2stoc", "det2stoc+psis")
WITHOUT = {  # methods that a problem of vectors has no use for; npe would simulate ten windows for each of its pairs
    "trivariate": ("population_search", "det2stoc", "det2stoc+psis"),
    "windy_slope": ("population_search", "det2stoc", "det2stoc+psis", "npe", "npe+psis"),
}
HEADINGS = ("problem", "method", "C2ST", "mean [sd]", "sd [%]", "k-hat", "ESS", "ESS/s", "s", "simulations", "verdict")


def compared(problem: str, methods: Sequence[str], out: Path, num_samples: int) -> Iterator[dict[str, Any]]:
    """What `det2stoc compare --json` says, a line a method, and the seconds that all of them took."""
    command = [sys.executable, "-m", "det2stoc_bayes", "compare", problem, "--methods", ",".join(methods), "--json"]
    began = time.perf_counter()
    told = subprocess.run(
        [*command, "--out", str(out / problem), "--num-samples", str(num_samples)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    found, seconds = json.loads(told.stdout), round(time.perf_counter() - began, 1)
    about = {"problem": problem, "reference": found["reference"], "seconds_of_all": seconds}
    for row in found["rows"]:
        yield about | row
    for label, why in found["failed"].items():
        yield about | {"label": label, "why": why, "verdict": "could not run"}


def row(line: Mapping[str, Any]) -> str:
    """A line of the log as a line of Markdown."""

    def number(key: str, digits: int = 3, times: float = 1.0) -> str:
        value = line.get(key)
        return "" if value is None else f"{times * value:.{digits}g}"

    seconds = line.get("seconds_compile", 0.0) + line.get("seconds_run", 0.0)
    cells = (line["problem"], line["label"], number("c2st"), number("mean_error", 2), number("sd_error", 2, 100.0),
             number("k_hat", 2), number("ess"), number("ess_per_second"), f"{seconds:.0f}",
             str(line.get("simulations", "")), line["verdict"])  # fmt: skip
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Each method on each problem."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("problems", nargs="*", help=f"of: {', '.join(PROBLEMS)}; all unless told")
    parser.add_argument("--methods", help="those that suit each problem unless told")
    parser.add_argument("--num-samples", type=int, default=4000)
    parser.add_argument("--out", type=Path, default=Path("out/compare"))
    options = parser.parse_args()
    if wrong := set(options.problems) - set(PROBLEMS):
        parser.error(f"unknown problems {', '.join(sorted(wrong))}; allowed: {', '.join(PROBLEMS)}")
    print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}")
    for problem in options.problems or PROBLEMS:
        without = () if options.methods else WITHOUT.get(problem, ())
        methods = (options.methods or ",".join(m for m in (*EXACT, *OTHERS) if m not in without)).split(",")
        for line in compared(problem, methods, options.out, options.num_samples):
            append(LOG, {"commit": revision()} | line)
            print(row(line), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
