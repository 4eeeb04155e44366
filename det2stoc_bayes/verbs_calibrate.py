"""The command `calibrate` as a function: what is simulated, what draws of its posterior, and who does the work."""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from det2stoc_bayes.errors import MethodNotApplicable, listing
from det2stoc_bayes.problem import Problem, make_problem
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import Study
from det2stoc_bayes.vector_density import Inferred
from det2stoc_bayes.verbs import chosen_method

if TYPE_CHECKING:
    import numpy as np

    from det2stoc_bayes.calibration import Calibration, Fit, Replicate
    from det2stoc_bayes.engines.base import Start
    from det2stoc_bayes.vector_problem import Posed

type Progress = Callable[[str, int, int], None]


def calibrate(
    problem: Study | str,
    method: str,
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    engine: str = "c",
    num_replications: int = 500,
    num_samples: int = 200,
    jobs: int = 0,
    cluster: str | None = None,
    progress: Progress = lambda *_: None,
) -> "Calibration":
    """Whether a method's posteriors hold the truth as often as they say, on a study or a problem of `models`.

    Replications that `out` holds are not done again. Results follow from `seed`, whatever does the work: `jobs`
    processes (0: one a core), or the workers of the Dask scheduler `cluster`.
    """
    from det2stoc_bayes.calibration import Experiment, judge, run
    from det2stoc_bayes.executors import workers
    from det2stoc_bayes.inference import NO_POSTERIOR
    from det2stoc_bayes.models import VECTORS

    label, name, options = chosen_method(method, "--method")
    if name in NO_POSTERIOR:
        raise MethodNotApplicable(f"--method: {name} infers no posterior; allowed: a method that does, as nuts")
    vectors = isinstance(problem, str) and problem in VECTORS
    source: _Source = (
        _vectors(str(problem), name, options, engine) if vectors else _Study(problem, name, options, engine)
    )
    made = {"content": source.content, "version": version("det2stoc-bayes"), "method": label}
    made |= {"seed": seed, "engine": engine, "num_samples": num_samples}
    with workers(jobs, cluster, progress, most=num_replications) as executor:

        def prepare() -> Experiment:
            pose, fit = source.prepare(executor, seed, progress)
            return Experiment(pose, fit, seed, num_samples)

        path = Path(out) / "replications.jsonl"
        every = run(prepare, num_replications, executor, path, made, lambda done, of: progress("calibrating", done, of))
    called = problem if isinstance(problem, str) else problem.name
    return judge(every, problem=called, method=label, trained_once=source.learns_once, seed=seed)


@runtime_checkable
class _Source(Protocol):
    """What is calibrated: `content` changes with it."""

    content: str
    learns_once: bool

    def prepare(self, executor: Executor, seed: int, progress: Progress) -> "tuple[Callable[[], Replicate], Fit]":
        """What makes replications, and what draws from their posteriors; both can be pickled."""
        ...


class _Study:
    """A study's recordings, or those of one of `models`."""

    def __init__(self, source: Study | str, method: str, options: Mapping[str, Any], engine: str):
        from det2stoc_bayes.inference import get_method

        self.method, self.options, self.pose = method, options, partial(_posed, source, engine)
        self.believed = self.pose()
        self.content = self.believed.simulator.fingerprint
        self.learns_once = hasattr(get_method(method), "train")

    def prepare(self, executor: Executor, seed: int, progress: Progress) -> "tuple[Callable[[], Replicate], Fit]":
        from det2stoc_bayes.replication import fitted_start

        progress("fitting where the recordings begin", 0, 1)
        start, fit = fitted_start(self.believed), partial(_fitted, self.method, self.options)
        progress("fitting where the recordings begin", 1, 1)
        if self.learns_once:
            trained = _once(executor, partial(_trained, self.method, self.pose), seed, self.method, progress)
            fit = partial(_applied, self.method, trained, self.options)
        return partial(_replicator, self.pose, start), fit


def _vectors(problem: str, method: str, options: Mapping[str, Any], engine: str) -> "_Source":
    """A problem of vectors, which `npe` learns once; other methods take one that has an observation of its own."""
    from det2stoc_bayes.models import POSED, posed

    if problem in POSED and method != "npe":
        return _Posed(posed(problem, engine), method, options)
    if method != "npe":
        allowed = listing(("npe", "npe+psis"))
        raise MethodNotApplicable(f"--method: {problem} is a problem of vectors; found {method}; allowed: {allowed}")
    return _Vectors(problem, options)


class _Posed:
    """A problem of vectors, each of whose replications is posed anew."""

    learns_once = False

    def __init__(self, problem: "Posed", method: str, options: Mapping[str, Any]):
        self.problem, self.method, self.options, self.content = problem, method, options, problem.fingerprint

    def prepare(self, executor: Executor, seed: int, progress: Progress) -> "tuple[Callable[[], Replicate], Fit]":
        progress("simulating what the likelihood is made of", 0, 1)
        self.problem.problem.prepare()
        progress("simulating what the likelihood is made of", 1, 1)
        return partial(_posing, self.problem), partial(_fitted, self.method, self.options)


class _Vectors:
    """A problem of vectors, which `npe` learns."""

    learns_once = True

    def __init__(self, problem: str, options: Mapping[str, Any]):
        self.content, self.options = problem, options

    def prepare(self, executor: Executor, seed: int, progress: Progress) -> "tuple[Callable[[], Replicate], Fit]":
        flow = _once(executor, partial(_flow_of, self.content), seed, "npe", progress)
        return partial(_drawing, self.content), partial(_flow_applied, self.content, flow, self.options)


def _once(executor: Executor, train: Callable[[int], Any], seed: int, name: str, progress: Progress) -> Any:
    """What is learned for all replications, by a worker."""
    from det2stoc_bayes.executors import finished

    progress(f"training {name}", 0, 1)
    ((_, trained),) = finished(executor, train, [seed])
    progress(f"training {name}", 1, 1)
    return trained()


def _posed(source: Study | str, engine: str) -> Problem:
    """A study's problem or one of `models`, which one thread simulates."""
    from det2stoc_bayes.models import get_problem
    from det2stoc_bayes.replication import bare

    if isinstance(source, str):
        return bare(get_problem(source, engine=engine, num_threads=1))
    return bare(make_problem(Simulator(source, engine, num_threads=1)))


def _replicator(posed: Callable[[], Problem], start: "Start") -> "Replicate":
    from det2stoc_bayes.replication import replicate

    return partial(replicate, posed(), start)


def _fitted(name: str, options: Mapping[str, Any], problem: Inferred, key: int, *, num_samples: int) -> Any:
    from det2stoc_bayes.inference import get_method

    return get_method(name).fit(problem, key, num_samples=num_samples, **options)


def _trained(name: str, posed: Callable[[], Problem], seed: int) -> Any:
    from det2stoc_bayes.inference import get_method

    return get_method(name).train(posed(), seed)


def _applied(
    name: str, trained: Any, options: Mapping[str, Any], problem: Problem, key: int, *, num_samples: int
) -> Any:
    from det2stoc_bayes.inference import get_method

    return get_method(name).apply(trained, problem, key, num_samples=num_samples, **options)


def _posing(problem: "Posed") -> "Replicate":
    def replicate(random: "np.random.Generator") -> "tuple[Posed, Mapping[str, float]]":
        x, truth = problem.problem.replicate(random)
        return replace(problem, x=x), truth

    return replicate


def _drawing(name: str) -> "Replicate":
    from det2stoc_bayes.models import vector_problem

    return vector_problem(name).replicate


def _flow_of(name: str, seed: int) -> Any:
    from det2stoc_bayes.inference._vectors import train
    from det2stoc_bayes.models import vector_problem

    return train(vector_problem(name), seed)


def _flow_applied(name: str, flow: Any, options: Mapping[str, Any], x: Any, key: int, *, num_samples: int) -> Any:
    from det2stoc_bayes.inference._vectors import apply
    from det2stoc_bayes.models import vector_problem

    return apply(flow, vector_problem(name), x, key, num_samples=num_samples, **options)
