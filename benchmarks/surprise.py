"""Amortized posteriors of a right and of a wrong model: does what they say of themselves tell the two apart?

One study of a pendulum conceals nothing, the other dry friction of its pivot. `det2stoc` tells how surprising the
recordings are among its simulations, with a p-value; k-hat is that of its draws' weights under the exact likelihood.
Lines go to benchmarks/results/surprise.jsonl.
"""

import argparse
import tempfile
from pathlib import Path

from logs import append

from det2stoc_bayes.blind.conceal import make_case
from det2stoc_bayes.blind.proof import revision
from det2stoc_bayes.doubts import doubts, weights
from det2stoc_bayes.inference import det2stoc
from det2stoc_bayes.mismatch.finding import plain
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.run_statistics import surprise_p
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import load_study

LOG = Path(__file__).parent / "results" / "surprise.jsonl"
REFINES = "none", "psis"
CASES = {"nothing": {"control": True}, "coulomb_friction": {"effect": "coulomb_friction"}}


def main() -> int:
    """Both studies, the method as it is and refined."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, default=7, help="of the concealed studies")
    parser.add_argument("--num-samples", type=int, default=1000)
    options = parser.parse_args()
    print("| concealed | method | surprise, p | k-hat | what it says |\n|---|---|---|---|---|")
    for name, kind in CASES.items():
        case = make_case(options.seed, system="pendulum", **kind)
        with tempfile.TemporaryDirectory() as folder:
            study = load_study(case.write(Path(folder) / "study"))
            problem = make_problem(Simulator(study, "c", 0))
            trees = det2stoc.refinements(problem, 0, REFINES, num_samples=options.num_samples)
            for refine, tree in zip(REFINES, trees, strict=True):
                k_hat, said = (weights(tree) or (None, 0))[0], doubts(tree)
                line = {"commit": revision(), "seed": options.seed, "concealed": name, "refine": refine}
                line |= {"p": surprise_p(tree), "k_hat": k_hat, "doubts": said}
                append(LOG, plain(line))  # k-hat may be infinite
                method = "det2stoc" if refine == "none" else "det2stoc+psis"
                numbers = " | ".join("" if n is None else f"{n:.2g}" for n in (line["p"], k_hat))
                print(f"| {name} | {method} | {numbers} | {' '.join(said) or 'nothing against it'} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
