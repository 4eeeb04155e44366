"""Concealed studies diagnosed one after another by a process that sees a copy of the study alone, and scored.

Every run is appended to benchmarks/results/concealed.jsonl; the table of the last ones is printed.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from det2stoc_bayes.blind.conceal import ConcealedCase, make_case
from det2stoc_bayes.blind.score import CaseScore, score, score_table

LOG = Path(__file__).parent / "results" / "concealed.jsonl"


def diagnosed(case: ConcealedCase) -> tuple[dict, float]:
    """diagnosis.json of a nameless copy of a case's study, and the seconds that it took."""
    with tempfile.TemporaryDirectory() as folder:
        study, out = Path(folder) / "study", Path(folder) / "out"
        case.write(study)
        began = time.perf_counter()
        command = [sys.executable, "-m", "det2stoc_bayes", "diagnose", str(study), "--out", str(out)]
        subprocess.run(command, check=True, capture_output=True, text=True)
        return json.loads((out / "diagnosis.json").read_text("utf-8")), time.perf_counter() - began


def revision() -> str:
    """The commit that is checked out."""
    return subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()


def one(seed: int, control: bool, commit: str) -> CaseScore:
    """Make, diagnose, score and log one case."""
    case = make_case(seed, control=control)
    diagnosis, seconds = diagnosed(case)
    result = score(case.answer, diagnosis)
    row = {
        "commit": commit,
        "seed": seed,
        "control": control,
        "seconds": round(seconds, 1),
        "answer": case.answer,
        "verdict": diagnosis["verdict"],
        "effects": diagnosis["effects"],
        "candidates": diagnosis["candidates"],
        "fit": diagnosis["fit"],
        "score": asdict(result),
    }
    LOG.parent.mkdir(exist_ok=True)
    with LOG.open("a", encoding="utf-8") as log:
        log.write(json.dumps(row) + "\n")
    return result


def main() -> None:
    """Cases with an effect, then controls with none."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, help="of the first case; default: first 8 hex digits of HEAD")
    parser.add_argument("--cases", type=int, default=10)
    parser.add_argument("--controls", type=int, default=5)
    a = parser.parse_args()
    commit, console = revision(), Console()
    first = int(commit[:8], 16) if a.seed is None else a.seed
    scores, names = [], []
    for k in range(a.cases + a.controls):
        seed, control = first + k, k >= a.cases
        scores.append(one(seed, control, commit))
        names.append(str(seed))
        console.print(f"{k + 1}/{a.cases + a.controls}: {scores[-1].truth} -> {scores[-1].diagnosed}")
    console.print(score_table(scores, names))


if __name__ == "__main__":
    main()
