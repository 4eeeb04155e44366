"""A diagnosis by a process of its own, which is given a nameless copy of a study and nothing else."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Timer
from typing import Any

import det2stoc_bayes
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.files import write_all

DIAGNOSE = ("-m", "det2stoc_bayes", "diagnose")  # of this Python, followed by STUDY --out DIR
INTERRUPTED = (130, -signal.SIGINT, -signal.SIGTERM)
LONGEST = 2000  # characters of what a failed one said
LIMIT = 7200.0  # s that one may take; it is killed then, and scored as failed


@dataclass(frozen=True)
class Outcome:
    """diagnosis.json, or how the process failed; one rollout to look at; seconds, and megabytes at the peak."""

    diagnosis: dict[str, Any]
    rollout: dict[str, Any] | None
    seconds: float
    megabytes: float


class Children:
    """Processes of this one; once ended, none starts any more. Threads may share it."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen] = set()
        self._lock, self._over = Lock(), False

    def wait(self, command: Sequence[str], **options: Any) -> tuple[int, float]:
        """Run a command, for LIMIT at most: its exit code, and its peak memory in megabytes."""
        with self._lock:
            if self._over:
                raise Det2StocError("interrupted")
            child = subprocess.Popen(command, **options)
            self._running.add(child)
        late = Timer(LIMIT, child.kill)
        late.start()
        try:
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        except BaseException:
            child.kill()
            child.wait()
            raise
        finally:
            late.cancel()
            self._running.discard(child)
        return child.returncode, usage.ru_maxrss / 1024.0

    def end(self) -> None:
        """Terminate what runs."""
        with self._lock:
            self._over = True
            for child in list(self._running):
                child.terminate()


def diagnosed(
    files: Mapping[str, bytes], arguments: Sequence[str] = DIAGNOSE, children: Children | None = None
) -> Outcome:
    """Diagnose a study of these files by `python ARGUMENTS STUDY --out DIR` in a folder that has nothing else.

    Raises Det2StocError where that was interrupted; what fails otherwise is an outcome.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        study, out, said = folder / "study", folder / "out", folder / "said"
        write_all(study, files)
        package = str(Path(det2stoc_bayes.__file__).parents[1])
        paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
        command = [sys.executable, *arguments, str(study), "--out", str(out)]
        began = time.perf_counter()
        with said.open("w") as text:
            code, megabytes = (children or Children()).wait(
                command, stdin=subprocess.DEVNULL, stdout=text, stderr=subprocess.STDOUT, cwd=folder, env=environment
            )
        seconds, result = time.perf_counter() - began, out / "diagnosis.json"
        if code in INTERRUPTED:
            raise Det2StocError("interrupted")
        if code or not result.is_file():
            told = said.read_text("utf-8", errors="replace")[-LONGEST:]
            if seconds >= LIMIT:
                told = f"killed after {LIMIT:.0f} s; {told}"
            return Outcome({"verdict": f"failed ({code})", "error": told}, None, seconds, megabytes)
        return Outcome(json.loads(result.read_text("utf-8")), _rollout(out / "fit.nc"), seconds, megabytes)


def _rollout(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    from det2stoc_bayes.report.glimpse import glimpse  # it takes a second to import

    return glimpse(path)
