"""Work that fans out: here, in spawned processes, on a Dask cluster on loopback one of whose workers is killed."""

import importlib
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import active_children

import pytest

from det2stoc_bayes import executors, verbs, verbs_calibrate
from det2stoc_bayes.blind import proof
from det2stoc_bayes.blind.conceal import ConcealedCase
from det2stoc_bayes.blind.draw import Choice
from det2stoc_bayes.errors import Det2StocError, SamplingFailed
from det2stoc_bayes.executors import Here, WorkersLost, finished, workers
from det2stoc_bayes.models import linear_gaussian
from det2stoc_bayes.study import load_study

NUM_REPLICATIONS = 10


def halved(number):
    if number % 2:
        raise SamplingFailed(f"{number} is odd")
    return number // 2, os.getpid()


def ending(number):
    os._exit(number)


def runs(number):
    """Whether there is such a process."""
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    return True


def precision(_):
    import jax

    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    return before


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_and_errors_come_back(jobs):
    with workers(jobs) as executor:
        found = dict(finished(executor, halved, range(4)))
        assert found[2]()[0] == 1 and (found[2]()[1] == os.getpid()) == (jobs == 1)
        with pytest.raises(SamplingFailed, match="3 is odd"):
            found[3]()


def test_a_task_does_not_see_what_another_one_set():
    with workers(1) as executor:
        assert [result() for _, result in finished(executor, precision, range(2))] == [False, False]


def test_a_process_that_ends_is_an_error_and_no_traceback():
    with pytest.raises(WorkersLost, match="a worker process ended before its work"), workers(2) as executor:
        for _, result in finished(executor, ending, [3]):
            result()


def test_stopping_early_ends_the_processes():
    others, started = set(active_children()), set()
    with pytest.raises(KeyboardInterrupt), workers(2) as executor:
        for _ in finished(executor, time.sleep, [0, 600, 600, 600]):
            started = set(active_children()) - others
            assert len(started) == 2 and all(process.is_alive() for process in started)
            raise KeyboardInterrupt
    # By number: what the pool's own thread has waited for has no exit code here.
    deadline = time.monotonic() + 20
    while any(runs(process.pid) for process in started) and time.monotonic() < deadline:
        active_children()  # waits for those that have ended
        time.sleep(0.05)
    assert not any(runs(process.pid) for process in started)


def test_there_are_no_more_processes_than_tasks():
    with workers(8, most=1) as executor:
        assert isinstance(executor, Here)
    with workers(8, most=2) as executor:
        assert isinstance(executor, ProcessPoolExecutor)
        assert executor._max_workers == 2


@pytest.fixture
def threads(tmp_path, monkeypatch):
    """Simulation threads that `compare` of so many jobs grants these methods, none of which is drawn."""
    study = load_study(linear_gaussian.write_study(tmp_path / "slides", (0.3, -0.1), seed=1))
    importlib.import_module("det2stoc_bayes.comparison")  # whose own `finished` stays

    def granted(methods, jobs):
        seen = []
        monkeypatch.setattr(executors, "finished", lambda executor, draw, _: seen.append(draw.args[2]) or ())
        with pytest.raises(Det2StocError):
            verbs.compare(study, methods, tmp_path / "out", jobs=jobs)
        return seen

    return granted


def test_processes_of_compare_simulate_by_one_thread(threads):
    assert threads(["laplace", "prior"], 2) == [1]
    assert threads(["laplace", "prior"], 1) == [0]


def test_what_is_drawn_alone_has_all_cores(threads):
    """A single run, or several by the same learning; other processes measure distances."""
    assert threads(["laplace"], 2) == [0]
    assert threads(["npe", "npe+psis"], 2) == [0]


@pytest.fixture
def silent():
    """A server that does not speak first, as those of the web."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("localhost:8786", "found 'localhost:8786'; allowed: a Dask scheduler's address, as tcp://HOST:8786"),
        ("http://localhost:8786", "allowed: a Dask scheduler's address"),
        ("tcp://127.0.0.1:1", "no Dask scheduler answers there .*refused"),
        ("tcp://127.0.0.1:99999", "a port is at most 65535"),
    ],
)
def test_a_wrong_address_is_told_quickly(address, said):
    began = time.monotonic()
    with pytest.raises(Det2StocError, match=said), workers(cluster=address):
        pass
    assert time.monotonic() - began < 20


def test_another_server_is_no_scheduler(silent):
    with pytest.raises(Det2StocError, match=r"no Dask scheduler answers there \(timed out\)"), workers(cluster=silent):
        pass


def test_without_dask_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    said = r"pip install 'det2stoc-bayes\[cluster\]'"
    with pytest.raises(Det2StocError, match=said), workers(cluster="tcp://127.0.0.1:1"):
        pass


class Cluster:
    """`dask scheduler` and `dask worker` processes on loopback."""

    def __init__(self, num_workers=2):
        self.processes = []
        scheduler = self._start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", stderr=subprocess.PIPE)
        for line in scheduler.stderr:
            if found := re.search(r"tcp://127\.0\.0\.1:\d+", line):
                self.address = found[0]
                break
        threading.Thread(target=scheduler.stderr.read, daemon=True).start()
        for _ in range(num_workers):
            self._start("dask_worker", self.address, "--no-nanny", stderr=subprocess.DEVNULL)

    def _start(self, program, *arguments, **streams):
        line = [sys.executable, "-m", f"distributed.cli.{program}", *arguments, "--no-dashboard"]
        self.processes.append(subprocess.Popen(line, stdout=subprocess.DEVNULL, text=True, **streams))
        return self.processes[-1]

    def kill_a_worker(self):
        self.processes[1].kill()

    def end(self):
        for process in reversed(self.processes):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def cluster():
    made = Cluster()
    yield made
    made.end()


def test_a_cluster_without_a_worker_is_told(monkeypatch):
    monkeypatch.setattr(executors, "PATIENCE", 0.5)
    alone = Cluster(0)
    try:
        said = f"--cluster {alone.address}: found no worker within 0.5 s"
        with pytest.raises(Det2StocError, match=said), workers(cluster=alone.address):
            pass
    finally:
        alone.end()


def lines(out):
    """Replications by index, without what they took."""
    every = [json.loads(line) for line in (out / "replications.jsonl").read_text().splitlines()]
    return {line["index"]: {k: v for k, v in line.items() if k != "seconds"} for line in every}


def test_a_cluster_with_a_worker_killed_in_the_middle_finds_the_same(cluster, tmp_path):
    calibrate = partial(
        verbs_calibrate.calibrate, "linear_gaussian", "laplace", num_replications=NUM_REPLICATIONS, seed=4
    )
    seen = []

    def watch(stage, done, total):
        seen.append((stage, done))
        if (stage, done) == ("calibrating", 3):
            cluster.kill_a_worker()

    on_cluster = calibrate(tmp_path / "cluster", cluster=cluster.address, progress=watch)
    assert cluster.processes[1].wait(timeout=20) != 0 and cluster.processes[2].poll() is None
    here = calibrate(tmp_path / "here", jobs=2)
    assert [done for stage, done in seen if stage == "calibrating"] == list(range(NUM_REPLICATIONS + 1))
    assert lines(tmp_path / "cluster") == lines(tmp_path / "here") and len(lines(tmp_path / "here")) == NUM_REPLICATIONS
    assert (on_cluster.unknowns, on_cluster.p_tarp) == (here.unknowns, here.p_tarp)


def test_methods_and_seeds_are_compared_on_a_cluster_as_here(cluster, tmp_path):
    """Its posterior is known: distances from that are measured there, too."""
    options = {"num_samples": 200, "num_seeds": 2}
    compare = partial(verbs.compare, "linear_gaussian", ["laplace", "prior"], **options)
    there = compare(tmp_path / "there", cluster=cluster.address)
    here, pool = compare(tmp_path / "here", jobs=1), compare(tmp_path / "here", jobs=2)
    distances = [[(r.c2st, r.wasserstein, r.kl, r.mean_error, r.sd_error) for r in x.rows] for x in (there, here, pool)]
    assert distances[0] == distances[1] == distances[2] and None not in distances[0][0]
    assert [row.label for row in there.rows] == ["laplace", "laplace, seed 1", "prior", "prior, seed 1"]
    for one, other in zip(there.runs, here.runs, strict=True):
        for group in ("posterior", "sample_stats", "log_likelihood"):
            assert one.tree[group].identical(other.tree[group])
    assert not (there.runs[0].draws == there.runs[1].draws).all()
    assert sorted(p.name for p in (tmp_path / "there" / "runs").iterdir()) == [
        "laplace.nc", "laplace_seed_1.nc", "prior.nc", "prior_seed_1.nc",
    ]  # fmt: skip


DIAGNOSIS = """
import pathlib, sys
out = pathlib.Path(sys.argv[3])
out.mkdir()
said = pathlib.Path(sys.argv[1], "study.toml").read_text()
(out / "diagnosis.json").write_text('{"verdict": "no_mismatch", "summary": "%s %s"}' % (said, pathlib.Path.cwd().name))
"""


def nothing_concealed(seed, kind, index, choice):
    return ConcealedCase(index, {"study.toml": f"study {index}"}, {"verdict": "no_mismatch", "effects": [], "psi": {}})


def test_concealed_studies_go_to_a_cluster_as_files(cluster, tmp_path):
    script = tmp_path / "diagnosis.py"
    script.write_text(DIAGNOSIS)
    options = {"seed": "1", "draw": nothing_concealed, "arguments": (str(script),), "cluster": cluster.address}
    lines = proof.run({"control": 3}, Choice(), tmp_path / "log.jsonl", **options)
    assert [line["said"] for line in lines] == ["no_mismatch"] * 3
    said = [line["diagnosis"]["summary"].split() for line in lines]
    assert [words[1] for words in said] == ["0", "1", "2"] and len({words[2] for words in said}) == 3
