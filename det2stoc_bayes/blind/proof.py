"""Many cases made, diagnosed by processes that see the study alone, scored, and logged one by one."""

import json
import subprocess
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from joblib import cpu_count

from det2stoc_bayes.blind.child import DIAGNOSE, Children, Outcome, diagnosed
from det2stoc_bayes.blind.conceal import ConcealedCase
from det2stoc_bayes.blind.draw import KINDS, Choice, draw_case
from det2stoc_bayes.blind.score import score
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.executors import Progress, result_of, workers
from det2stoc_bayes.files import appending

KEPT = ("verdict", "summary", "effects", "candidates", "fit", "psi", "error")
ON_A_CLUSTER = 128  # studies on their way at a time

type Line = dict[str, Any]
type Key = tuple[str, int]  # kind and number
type Draw = Callable[[str, str, int, Choice], ConcealedCase]
type Diagnose = Callable[[Mapping[str, bytes]], Outcome]
type Work = Callable[[Key], tuple[Key, ConcealedCase, Outcome]]


def revision() -> str:
    """The commit that is checked out in the working folder; empty where there is none."""
    try:
        run = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return run.stdout.strip() if run.returncode == 0 else ""


def run(
    counts: Mapping[str, int],
    choice: Choice,
    log: Path,
    *,
    seed: str,
    commit: str = "",
    jobs: int = 1,
    cluster: str | None = None,
    arguments: Sequence[str] = DIAGNOSE,
    draw: Draw = draw_case,
    progress: Progress = lambda *_: None,
) -> list[Line]:
    """The log's lines of so many cases of each kind, in order; those that it lacks are made, diagnosed and appended.

    `jobs` cases at a time (0: one a core) are drawn by processes of this machine, and diagnosed by others or, as files
    alone, by the workers of the Dask scheduler `cluster`. `draw` and `arguments` are how that is done.
    """
    made = json.loads(json.dumps({"commit": commit, "seed": seed, "choice": asdict(choice)}))
    wanted = [(kind, index) for kind in KINDS for index in range(counts.get(kind, 0))]
    with appending(log) as (lines, append):
        done = {(x["kind"], x["index"]): x for x in _told(lines) if all(x.get(k) == v for k, v in made.items())}
        missing = [key for key in wanted if key not in done]
        there = len(wanted) - len(missing)
        progress("diagnosing concealed cases", there, len(wanted))
        if missing:
            make = partial(_drawn, draw, seed, choice)
            with (
                _working(make, arguments, jobs or cpu_count(), cluster, progress) as (work, at_once),
                closing(_every(work, missing, at_once)) as results,
            ):
                for number, (key, case, outcome) in enumerate(results, there + 1):
                    done[key] = made | _line(key, case, outcome)
                    append(done[key])
                    progress("diagnosing concealed cases", number, len(wanted))
    return [done[key] for key in wanted]


def read(log: Path) -> tuple[list[Line], int]:
    """A log's cases, the last line of each, and how many lines are something else or were cut off."""
    if not log.is_file():
        raise Det2StocError(f"--rescore {log}: no such file; allowed: a log of `det2stoc blind` (.jsonl)")
    lines, other = [], 0
    for text in log.read_text("utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except ValueError:
            line = None
        found = list(_told([line] if isinstance(line, dict) else []))
        lines += found
        other += not found
    keyed = {(x.get("commit"), x.get("seed"), json.dumps(x.get("choice")), x["kind"], x["index"]): x for x in lines}
    return list(keyed.values()), other


def _told(lines: Iterable[Line]) -> Iterator[Line]:
    """Lines that are cases."""
    for line in lines:
        whole = {"kind", "index", "answer", "diagnosis", "seconds", "peak_mb"} <= line.keys()
        whole = whole and isinstance(line["kind"], str) and line["kind"] in KINDS
        whole = whole and all(isinstance(line[key], dict) for key in ("answer", "diagnosis"))
        if whole and "effects" in line["answer"] and "verdict" in line["diagnosis"]:
            yield line


def _drawn(draw: Draw, seed: str, choice: Choice, key: Key) -> ConcealedCase:
    return draw(seed, *key, choice)


def _line(key: Key, case: ConcealedCase, outcome: Outcome) -> Line:
    """A case in the log."""
    told = {name: outcome.diagnosis[name] for name in KEPT if name in outcome.diagnosis}
    line: Line = {"kind": key[0], "index": key[1], "case_seed": case.seed}
    line |= {"seconds": round(outcome.seconds, 3), "peak_mb": round(outcome.megabytes, 1)}
    line |= {"answer": case.answer, "diagnosis": told, "said": score(case.answer, told).diagnosed}
    return line | ({"rollout": outcome.rollout} if outcome.rollout else {})


@contextmanager
def _working(
    make: Callable[[Key], ConcealedCase],
    arguments: Sequence[str],
    jobs: int,
    cluster: str | None,
    progress: Progress,
) -> Iterator[tuple[Work, int]]:
    """What makes and diagnoses one case, and how many of it may run at once."""
    children = Children()
    try:
        if cluster is None:
            with workers(jobs) as makers:
                here = partial(diagnosed, arguments=arguments, children=children)
                yield partial(_diagnosed, partial(_made, makers, make), here), jobs
            return
        with workers(cluster=cluster, progress=progress) as others, workers(max(jobs, 2)) as makers:
            away = partial(sent, others, diagnosed, arguments=arguments)
            yield partial(_diagnosed, partial(_made, makers, make), away), ON_A_CLUSTER
    finally:
        children.end()


def _diagnosed(
    made: Callable[[Key], ConcealedCase], diagnose: Diagnose, key: Key
) -> tuple[Key, ConcealedCase, Outcome]:
    """A case, without its files, and what is said of it."""
    case = made(key)
    return key, replace(case, study_files={}), diagnose(case.encoded())


def sent(
    others: Executor,
    diagnose: Callable[..., Outcome],
    files: Mapping[str, bytes],
    arguments: Sequence[str],
) -> Outcome:
    """The same by another machine, which gets the files and nothing else."""
    return result_of(others.submit(diagnose, files, arguments))


def _made(makers: Executor, make: Callable[[Key], ConcealedCase], key: Key) -> ConcealedCase:
    try:
        return result_of(makers.submit(make, key))
    except ValueError as error:
        raise Det2StocError(f"{key[0]} {key[1]}: {error}; allowed: other --systems or --names") from error


def _every(work: Work, keys: Sequence[Key], at_once: int) -> Generator[tuple[Key, ConcealedCase, Outcome]]:
    """Results as they come."""
    if at_once == 1:
        yield from map(work, keys)
        return
    pool = ThreadPoolExecutor(at_once)
    waiting = {pool.submit(work, key) for key in keys}
    try:
        for future in as_completed(waiting):
            waiting.discard(future)
            yield future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
