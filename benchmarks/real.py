"""Real recordings: every study of a folder is diagnosed by a process of its own, and a table is printed as Markdown.

Results go to benchmarks/results/real.jsonl, one line a study; the recordings themselves are not part of this project.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from logs import append

from det2stoc_bayes.blind.proof import revision

LOG = Path(__file__).parent / "results" / "real.jsonl"
KEPT = ("verdict", "summary", "effects", "candidates", "negligible", "evidence", "fit", "psi", "seconds")


def diagnosed(study: Path) -> dict[str, Any]:
    """diagnosis.json of a study, or what went wrong."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        command = [sys.executable, "-m", "det2stoc_bayes", "diagnose", str(study), "--out", folder]
        run = subprocess.run(command, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - began
        result = Path(folder) / "diagnosis.json"
        if run.returncode or not result.is_file():
            return {"study": study.name, "verdict": f"failed ({run.returncode})", "seconds": seconds}
        content = json.loads(result.read_text("utf-8"))
        about = {"commit": revision()[:7], "study": study.name}
        return about | {key: content[key] for key in KEPT if key in content} | {"seconds": seconds}


def studies(folder: Path, names: Sequence[str]) -> list[Path]:
    """Studies of a folder, all of them where none is named; ends the program where one is missing."""
    found = {p.name: p for p in sorted(folder.glob("*")) if (p / "study.toml").is_file()}
    missing = [name for name in names if name not in found]
    if missing or not found:
        there = ", ".join(found) or "none"
        raise SystemExit(
            f"{folder}: no study {' '.join(missing)}; there are: {there}; allowed: STUDIES=folder of studies"
        )
    return [found[name] for name in names or found]


def ratio(line: Mapping[str, Any]) -> str:
    """Rollout error after over before, the worst column's."""
    before, after = (line.get("fit", {}).get(f"rollout_rmse_{w}", {}) for w in ("before", "after"))
    found = [after[c] / before[c] for c in before if before[c] and after.get(c) is not None]
    return f"{max(found):.2f}" if found else "-"


def main() -> int:
    """Diagnose the studies of a folder."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("names", nargs="*", help="studies to run; all of them if none is named")
    parser.add_argument("--studies", type=Path, required=True, help="folder of studies")
    options = parser.parse_args()
    chosen = studies(options.studies, options.names)
    print("| study | verdict | what is said | held-out error after / before | seconds |\n|---|---|---|---|---|")
    for study in chosen:
        line = diagnosed(study)
        append(LOG, line)
        said = line.get("summary", "")
        print(f"| {line['study']} | {line['verdict']} | {said} | {ratio(line)} | {line['seconds']:.0f} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
