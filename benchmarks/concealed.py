"""Concealed studies, each diagnosed by a process that sees a nameless copy of the study alone, and scored.

Every case is appended to benchmarks/results/concealed.jsonl; the same seed and commit goes on where it stopped.
A summary of the run is printed as Markdown.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from det2stoc_bayes.blind.conceal import ConcealedCase, make_case
from det2stoc_bayes.blind.laws import LAWS
from det2stoc_bayes.blind.score import CaseScore, label, score
from det2stoc_bayes.blind.summary import Row, markdown
from det2stoc_bayes.blind.systems import SMOOTH, SYSTEMS
from det2stoc_bayes.blind.variants import possible

LOG = Path(__file__).parent / "results" / "concealed.jsonl"
KINDS = ("effect", "pair", "control")
MOST_VARIANTS = 2  # at once
MOST_DRAWS = 100


def revision() -> str:
    """The commit that is checked out."""
    return subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()


@dataclass(frozen=True)
class Choice:
    """From which systems cases are drawn, whether all are free of variants, and what they conceal (in turn)."""

    systems: tuple[str, ...] = SMOOTH
    plain: bool = False
    names: tuple[str, ...] = ()


def draw_case(seed: str, kind: str, index: int, choice: Choice) -> ConcealedCase:
    """Case `index` of a kind; half of all have one or two variants. What cannot be concealed is drawn again."""
    rng = np.random.default_rng([int(seed, 16), KINDS.index(kind), index])
    effect = choice.names[index % len(choice.names)] if choice.names and kind == "effect" else None
    for _ in range(MOST_DRAWS):
        system = choice.systems[rng.integers(len(choice.systems))]
        options = possible(SYSTEMS[system])
        count = int(rng.integers(1, MOST_VARIANTS + 1)) if rng.uniform() < 0.5 and not choice.plain else 0
        variants = tuple(sorted(rng.choice(options, count, replace=False).tolist()))
        number = int(rng.integers(2**31))
        try:
            pair, control = kind == "pair", kind == "control"
            return make_case(number, system=system, effect=effect, variants=variants, pair=pair, control=control)
        except ValueError:
            continue
    raise ValueError(f"{effect or 'an effect'}: concealed in none of {MOST_DRAWS} drawn systems")


def diagnosed(case: ConcealedCase) -> tuple[dict[str, Any], float, float]:
    """diagnosis.json of a nameless copy of a case's study, the seconds and the megabytes that it took."""
    with tempfile.TemporaryDirectory() as folder:
        study, out, said = Path(folder) / "study", Path(folder) / "out", Path(folder) / "said"
        case.write(study)
        began = time.perf_counter()
        command = [sys.executable, "-m", "det2stoc_bayes", "diagnose", str(study), "--out", str(out)]
        with said.open("w") as text:
            child = subprocess.Popen(command, stdout=text, stderr=subprocess.STDOUT)
            _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        seconds, megabytes = time.perf_counter() - began, usage.ru_maxrss / 1024.0
        result = out / "diagnosis.json"
        if child.returncode or not result.is_file():
            diagnosis = {"verdict": f"failed ({child.returncode})", "error": said.read_text("utf-8")[-2000:]}
            return diagnosis, seconds, megabytes
        return json.loads(result.read_text("utf-8")), seconds, megabytes


def one(seed: str, kind: str, index: int, commit: str, choice: Choice) -> dict[str, Any]:
    """Make, diagnose and score one case: its line in the log."""
    case = draw_case(seed, kind, index, choice)
    diagnosis, seconds, megabytes = diagnosed(case)
    kept = ("verdict", "effects", "candidates", "fit", "psi", "error")
    return {
        "commit": commit,
        "seed": seed,
        "choice": asdict(choice),
        "kind": kind,
        "index": index,
        "case_seed": case.seed,
        "seconds": round(seconds, 1),
        "peak_mb": round(megabytes, 1),
        "answer": case.answer,
        "diagnosis": {key: diagnosis[key] for key in kept if key in diagnosis},
        "said": score(case.answer, diagnosis).diagnosed,
    }


def scored(line: Mapping[str, Any]) -> CaseScore:
    """The score of a logged case, computed anew."""
    return score(line["answer"], line["diagnosis"])


def logged(path: Path) -> list[dict[str, Any]]:
    """The lines of a log; one that was cut off does not count."""
    lines = []
    for text in path.read_text("utf-8").splitlines() if path.is_file() else ():
        with contextlib.suppress(json.JSONDecodeError):
            lines.append(json.loads(text))
    return lines


def append(path: Path, line: Mapping[str, Any]) -> None:
    """One more line of a log."""
    path.parent.mkdir(exist_ok=True)
    with path.open("a", encoding="utf-8") as log:
        log.write(json.dumps(line) + "\n")


def finished(seed: str, commit: str, choice: Choice) -> dict[tuple[str, int], dict[str, Any]]:
    """Logged cases of this run, by kind and index."""
    wanted = json.loads(json.dumps({"seed": seed, "commit": commit, "choice": asdict(choice)}))
    found: dict[tuple[str, int], dict[str, Any]] = {}
    for line in logged(LOG):
        if "kind" in line and all(line.get(key) == value for key, value in wanted.items()):
            found[line["kind"], line["index"]] = line
    return found


def _workers(jobs: int) -> Executor:
    # Cases are made in Python for the most part: threads of one process would wait for each other.
    return ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) if jobs > 1 else ThreadPoolExecutor(1)


def run(seed: str, counts: Mapping[str, int], commit: str, jobs: int, choice: Choice) -> list[Row]:
    """All cases that are not in the log yet; gives every case's row, in order."""
    done = finished(seed, commit, choice)
    wanted = [(kind, index) for kind in KINDS for index in range(counts[kind])]
    with _workers(jobs) as pool:
        waiting = {key: pool.submit(one, seed, *key, commit, choice) for key in wanted if key not in done}
        try:
            for number, (key, future) in enumerate(waiting.items(), 1):
                line = future.result()
                done[key] = line
                append(LOG, line)
                truth = " + ".join(label(e) for e in line["answer"]["effects"]) or "nothing"
                print(f"{number}/{len(waiting)} {truth} -> {line['said']} ({line['seconds']:.0f} s)", file=sys.stderr)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    lines = [done[key] for key in wanted]
    return [(line["kind"], scored(line), line["seconds"], line["peak_mb"]) for line in lines]


def main() -> int:
    """Effects, pairs of effects, and controls with nothing concealed."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--effects", type=int, default=10)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--controls", type=int, default=5)
    parser.add_argument("--seed", help="hexadecimal; default: the first 8 digits of HEAD")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time")
    parser.add_argument("--systems", nargs="+", choices=tuple(SYSTEMS), default=SMOOTH, metavar="SYSTEM")
    parser.add_argument("--plain", action="store_true", help="no variants: states recorded evenly, noise told")
    parser.add_argument("--effects-named", nargs="+", choices=tuple(LAWS), default=(), metavar="EFFECT")
    a = parser.parse_args()
    commit = revision()
    seed = a.seed or commit[:8]
    try:
        int(seed, 16)
    except ValueError:
        parser.error(f"--seed {seed!r}; allowed: hexadecimal digits")
    if min(a.effects, a.pairs, a.controls) < 0 or a.jobs < 1:
        parser.error("counts are not negative, and --jobs is at least 1")
    counts = {"effect": a.effects, "pair": a.pairs, "control": a.controls}
    try:
        rows = run(seed, counts, commit, a.jobs, Choice(tuple(a.systems), a.plain, tuple(a.effects_named)))
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    print(f"Seed {seed}, commit {commit[:7]}\n\n{markdown(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
