"""Where work that fans out runs: in this process, in a pool of spawned ones, or on a Dask cluster.

Processes are spawned, never forked, since JAX does not survive a fork. Tasks of one process run one at a time:
JAX's precision is a setting of the whole process, and each task starts with it as a new process would.
"""

import os
import re
import signal
import socket
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.metadata import version
from multiprocessing import active_children, connection, get_context, parent_process
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any

from joblib import cpu_count

from det2stoc_bayes.errors import Det2StocError

if TYPE_CHECKING:
    import distributed

Progress = Callable[[str, int, int], None]

SECONDS = 5  # in which a scheduler answers
PATIENCE = 60  # s, in which a first worker comes
ADDRESS = re.compile(r"(tcp|tls)://(\[[^\]/\s]+\]|[^\s:/\[\]]+):\d{1,5}")
# Of BLAS, of XLA (its CPU client reads it when it starts) and of whatever asks joblib.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "PJRT_NPROC", "LOKY_MAX_CPU_COUNT")
BEAT = 2.0  # s
GOES_ON = "what is finished is kept, and the same command goes on"
_ALONE = Lock()


class WorkersLost(Det2StocError):
    """Workers ended before their work."""


class Here(Executor):
    """An executor that does the work when it is submitted, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """A future that is done."""
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def workers(
    jobs: int = 0, cluster: str | None = None, progress: Progress = lambda *_: None, most: int | None = None
) -> Iterator[Executor]:
    """An executor: this process (1 job), a pool of so many, or a cluster's workers.

    `jobs` 0: as many as there are cores. `most`: tasks, of which no process is to have none. Det2StocError: the
    cluster does not answer, or has not what is needed.
    """
    if cluster is not None:
        with _client(cluster) as client:
            progress(f"waiting for workers of {cluster}", 0, 1)
            try:
                client.wait_for_workers(1, timeout=PATIENCE)
            except TimeoutError as error:
                raise Det2StocError(
                    f"--cluster {cluster}: found no worker within {PATIENCE} s; allowed: one at least, as started by "
                    f"`dask worker {cluster}`"
                ) from error
            _check_versions(client)
            progress(f"waiting for workers of {cluster}", 1, 1)
            yield client.get_executor()
        return
    jobs = jobs or cpu_count()
    jobs = jobs if most is None else min(jobs, most)
    if jobs <= 1:
        yield Here()
        return
    others = set(active_children())
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_begin)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(active_children()) - others:
            process.terminate()
        raise
    pool.shutdown()


def finished[Item, Result](
    executor: Executor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    beat: Callable[[], None] = lambda: None,
) -> Iterator[tuple[Item, Callable[[], Result]]]:
    """Each item as its work ends, with what gives the result or raises what the work raised.

    `beat` is called now and then meanwhile. WorkersLost: processes were killed, or the cluster is gone. Items that wait
    are cancelled if the caller stops.
    """
    if isinstance(executor, Here):
        for item in items:
            yield item, executor.submit(_alone, function, item).result
        return
    waiting = {executor.submit(_alone, function, item): item for item in items}
    try:
        while waiting:
            done, _ = wait(waiting, BEAT, FIRST_COMPLETED)
            beat()
            for future in done:
                yield waiting.pop(future), lambda done=future: result_of(done)
    finally:
        for future in waiting:
            future.cancel()


def result_of(future: Future) -> Any:
    """What a worker found, once it has; its end as one line."""
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise WorkersLost(
            f"a worker process ended before its work (killed, or out of memory?); {GOES_ON}; allowed: fewer --jobs"
        ) from error
    except CancelledError as error:
        raise WorkersLost(f"--cluster: the scheduler is gone; {GOES_ON}") from error
    except Exception as error:
        if type(error).__module__.partition(".")[0] == "distributed":
            reason = " ".join(str(error).split())
            raise WorkersLost(f"--cluster: {type(error).__name__}: {reason}; {GOES_ON}") from error
        raise


def _alone[Item, Result](function: Callable[[Item], Result], item: Item) -> Result:
    """A task as in a new process, whatever ran in this one before."""
    with _ALONE:
        jax = sys.modules.get("jax")
        if jax is None:
            return function(item)
        before = jax.config.jax_enable_x64
        jax.config.update("jax_enable_x64", False)
        try:
            return function(item)
        finally:
            jax.config.update("jax_enable_x64", before)


def _begin() -> None:
    """A spawned worker: silent, one thread, Ctrl-C is the caller's, and it ends with the caller, however that ends."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    parent = parent_process()
    if parent is not None:
        Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


@contextmanager
def _client(address: str) -> "Iterator[distributed.Client]":
    """A connection to a scheduler."""
    if not ADDRESS.fullmatch(address):
        raise Det2StocError(f"--cluster: found '{address}'; allowed: a Dask scheduler's address, as tcp://HOST:8786")
    try:
        from distributed import Client
    except ImportError as error:
        raise Det2StocError(
            "--cluster: Dask is not installed; allowed: pip install 'det2stoc-bayes[cluster]'"
        ) from error
    try:
        _greet(address)
        client = Client(address, timeout=SECONDS, set_as_default=False)
    except Exception as error:  # of sockets, names, certificates, protocols: whatever the library meets
        reason = " ".join(str(error).split()) or type(error).__name__
        raise Det2StocError(
            f"--cluster {address}: no Dask scheduler answers there ({reason}); "
            "allowed: the address that `dask scheduler` prints"
        ) from error
    try:
        yield client
    finally:
        client.close(timeout=SECONDS)


def _greet(address: str) -> None:
    """An OSError where nobody speaks Dask's protocol: its client would wait for another server's answer for ever."""
    scheme, _, rest = address.partition("://")
    host, _, port = rest.rpartition(":")
    if int(port) > 65535:
        raise OSError("a port is at most 65535")
    with socket.create_connection((host.strip("[]"), int(port)), timeout=SECONDS) as line:
        # With tls it is the library's to speak first.
        if scheme == "tcp" and b"pickle-protocol" not in line.recv(4096):
            raise OSError("another server")


def _check_versions(client: "distributed.Client") -> None:
    """Every worker has this package in this version."""
    here = version("det2stoc-bayes")
    found: Any = client.run(_installed, on_error="return")
    for worker, there in found.items():
        if there != here:
            said = " ".join(str(there).split()) if isinstance(there, Exception) else f"det2stoc-bayes {there}"
            raise Det2StocError(f"--cluster: worker {worker}: found {said}; allowed: det2stoc-bayes {here}, as here")


def _installed() -> str:
    return version("det2stoc-bayes")
