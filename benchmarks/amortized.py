"""det2stoc beside a CVAE of recordings alone on real studies: log density of held-out transitions [nat].

Results go to benchmarks/results/amortized.jsonl, one line a study and method.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from logs import append
from real import studies

from det2stoc_bayes.blind.proof import revision

LOG = Path(__file__).parent / "results" / "amortized.jsonl"
METHODS = ("baseline_cvae", "det2stoc")
WAYS = ("matched", "mixture", "one_latent")


def fitted(study: Path, method: str) -> dict[str, Any]:
    """What `det2stoc fit --json` says of a study, and the seconds it took."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        command = [sys.executable, "-m", "det2stoc_bayes", "fit", str(study), "--method", method, "--out", folder]
        run = subprocess.run([*command, "--json"], stdout=subprocess.PIPE, text=True, check=True)
        told = json.loads(run.stdout)
    kept = {key: told[key] for key in ("parameters", "predictions", "simulations", "seed")}
    return {"study": study.name, "method": method, "seconds": round(time.perf_counter() - began, 1)} | kept


def row(line: Mapping[str, Any]) -> str:
    """A line of the log as a line of Markdown, means over all held-out transitions."""
    told = line["predictions"]
    weights = [t["num_transitions"] for t in told]
    means = [np.average([t[way] for t in told], weights=weights) for way in WAYS]
    cells = (line["study"], line["method"], *(f"{m:.2f}" for m in means), f"{line['seconds']:.0f}")
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Each method on each study."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("names", nargs="*", default=["pendulum_multiarm", "servo_xl330"], help="studies with holdout")
    parser.add_argument("--studies", type=Path, required=True, help="folder of studies")
    options = parser.parse_args()
    print("| study | method | matched Gaussian | mixture of 1000 z | one z | seconds |\n|---|---|---|---|---|---|")
    for study in studies(options.studies, options.names):
        for method in METHODS:
            line = {"commit": revision()} | fitted(study, method)
            append(LOG, line)
            print(row(line), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
