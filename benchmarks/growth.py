"""How time and memory of a diagnosis grow with the number of recordings: concealed effects, 1 to 8 times as many.

Lines go to benchmarks/results/growth.jsonl; ratios to the smallest study, all in one run, are printed.
"""

import argparse
from pathlib import Path

from logs import append

from det2stoc_bayes.blind.child import diagnosed
from det2stoc_bayes.blind.conceal import make_case
from det2stoc_bayes.blind.proof import revision
from det2stoc_bayes.blind.score import score

LOG = Path(__file__).parent / "results" / "growth.jsonl"
FEWEST, TIMES = 8, (1, 2, 4, 8)
CASES = (("pendulum", "coulomb_friction"), ("arm", "quadratic_damping"))


def main() -> int:
    """Each case with ever more recordings."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, default=7, help="of the concealed studies")
    seed, commit = parser.parse_args().seed, revision()
    print(
        "| system | effect | recordings | named | s | relative, a recording | peak MB |\n|---|---|---|---|---|---|---|"
    )
    for system, effect in CASES:
        first = None
        for times in TIMES:
            case = make_case(seed, system=system, effect=effect, num_recordings=FEWEST * times)
            found = diagnosed(case.encoded())
            named, seconds = score(case.answer, found.diagnosis).named, found.seconds
            first = first or seconds
            line = {"commit": commit, "seed": seed, "system": system, "effect": effect, "recordings": FEWEST * times}
            line |= {"named": named, "seconds": round(seconds, 1), "peak_mb": round(found.megabytes, 1)}
            append(LOG, line)
            cells = (system, effect, FEWEST * times, named, f"{seconds:.0f}", f"{seconds / first / times:.2f}")
            print(f"| {' | '.join(map(str, cells))} | {found.megabytes:.0f} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
