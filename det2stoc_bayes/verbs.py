"""Commands as functions that return objects, where one is more than a call. The frame never imports this."""

import inspect
import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from det2stoc_bayes.errors import MethodNotApplicable, SamplingFailed, SimulationDiverged, listing
from det2stoc_bayes.files import check_files
from det2stoc_bayes.problem import Problem, make_problem
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import Study

if TYPE_CHECKING:
    import numpy as np
    import xarray

    from det2stoc_bayes.comparison import Comparison, Kind, Reference
    from det2stoc_bayes.inference._stochastic import StochasticSimulator
    from det2stoc_bayes.mismatch.diagnose import Diagnosis
    from det2stoc_bayes.vector_density import Inferred
    from det2stoc_bayes.vector_problem import Posed


def fit(
    study: Study,
    method: str = "nuts",
    *,
    seed: int = 0,
    engine: str = "c",
    num_samples: int = 1000,
    num_threads: int = 0,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    **options: Any,
) -> "xarray.DataTree":
    """The posterior of psi by a method of `det2stoc_bayes.inference`; `options` are the method's own.

    `num_samples` draws in all, or as many more as make chains equally long; `num_threads` simulate (0: one a core).
    """

    def pose() -> Problem:
        return make_problem(Simulator(study, engine, num_threads))

    return _fitted(pose, method, seed, num_samples, progress, options)


def _fitted(
    pose: "Callable[[], Inferred]",
    method: str,
    seed: int,
    num_samples: int,
    progress: Callable[[str, int, int], None],
    options: dict[str, Any],
    by: str = "fit",
) -> Any:
    """What a method's function `by` makes of what `pose` gives, once the options are known to be the method's."""
    from det2stoc_bayes.inference import get_method

    run = getattr(get_method(method), by)
    known = inspect.signature(run).parameters
    for name in options:
        if name not in known:
            raise MethodNotApplicable(f"{method}: has no option '{name}'; allowed: {listing(list(known)[2:])}")
    if "progress" in known:
        options["progress"] = lambda done, total: progress("sampling", done, total)
    problem = pose()
    progress(stage := f"fitting by {method}", 0, 1)
    found = run(problem, seed, num_samples=num_samples, **options)
    progress(stage, 1, 1)
    return found


def compare(
    problem: Study | str,
    methods: Sequence[str],
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    num_seeds: int = 1,
    engine: str = "c",
    num_samples: int = 1000,
    jobs: int = 0,
    cluster: str | None = None,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> "Comparison":
    """Posteriors of several methods, `svi+psis` for a refined one, of a study or a problem of `models`.

    Those that `out` holds are not drawn again; a problem's recordings are written there, too.

    `out/runs` gets one .nc a method and seed (from `seed` on), each as soon as it is done, by `jobs` processes (1: this
    one, 0: one a core) or the workers of the Dask scheduler `cluster`, each of which simulates by one thread.
    """
    from det2stoc_bayes import posterior
    from det2stoc_bayes.comparison import Run, compare
    from det2stoc_bayes.executors import Here, finished, workers
    from det2stoc_bayes.inference import METHODS

    if not methods:
        raise MethodNotApplicable(f"--methods: none is named; allowed: some of {listing(METHODS)}, separated by commas")
    chosen = [chosen_method(label, "--methods") for label in dict.fromkeys(methods)]
    source, reference = (problem, None) if isinstance(problem, Study) else _known(problem, Path(out), seed, engine)
    content = Simulator(source).fingerprint if isinstance(source, Study) else source.fingerprint
    made = {"content": content, "version": version("det2stoc-bayes")}
    tasks: dict[str, tuple[str, dict[str, Any]]] = {}
    for label, name, options in chosen:
        for s in range(seed, seed + num_seeds):
            how: dict[str, Any] = {"seed": s, "engine": engine, "num_samples": num_samples} | options
            tasks[label if s == seed else f"{label}, seed {s}"] = name, how
    paths = {run: Path(out) / "runs" / f"{run.replace(', seed ', '_seed_')}.nc" for run in tasks}
    check_files(paths.values())
    asked = {run: how | made | {"method": name} for run, (name, how) in tasks.items()}
    trees = {run: posterior.load_made(paths[run], asked[run]) for run in tasks}
    missing, failed = [run for run, tree in trees.items() if tree is None], {}
    replaced = tuple(
        f"{paths[run]} was damaged or drawn otherwise, and is replaced" for run in missing if paths[run].exists()
    )
    done = len(tasks) - len(missing)
    progress("comparing methods", done, len(tasks))
    if missing and not isinstance(source, Study):
        source.problem.prepare()  # once, and not by every task
    together = _together(tasks, missing)
    with workers(jobs, cluster, progress, most=len(tasks)) as executor:
        drawing = Here() if len(together) == 1 and cluster is None else executor  # by all cores, with its own progress
        here = isinstance(drawing, Here)
        draw = partial(_drawn, source, tasks, 0 if here else 1, progress if here else _silent)
        for some, result in finished(drawing, draw, together):
            try:
                found = result()
            except (MethodNotApplicable, SamplingFailed, SimulationDiverged) as error:
                failed |= dict.fromkeys(some, str(error))  # the others may run
            else:
                for run, tree in zip(some, found, strict=True):
                    tree.attrs["asked"] = json.dumps(asked[run], sort_keys=True)
                    posterior.save(tree, paths[run])
                    trees[run] = tree
            done += len(some)
            progress("comparing methods", done, len(tasks))
        runs = [Run(run, tree, _kind(tasks[run][0])) for run, tree in trees.items() if tree is not None]
        if not runs:
            told = [w if w.startswith(f"{tasks[run][0]}:") else f"{run}: {w}" for run, w in failed.items()]
            raise MethodNotApplicable("; ".join(told))
        why = {run: failed[run] for run in tasks if run in failed}
        return compare(runs, reference, failed=why, replaced=replaced, executor=executor, progress=progress)


def _known(name: str, out: Path, seed: int, engine: str) -> "tuple[Study | Posed, Reference | None]":
    """A problem of `models`, as a study that is written or as one of vectors, and its posterior where that is known."""
    from det2stoc_bayes.comparison import known_reference
    from det2stoc_bayes.models import POSED, closed_form, posed, record
    from det2stoc_bayes.study import load_study

    if name in POSED:
        source = problem = posed(name, engine)
    else:
        source = load_study(record(name, out / "problem" / name))
        problem = make_problem(Simulator(source))
    exact = closed_form(name, problem)
    return source, None if exact is None else known_reference(*exact, problem, seed)


def _together(tasks: Mapping[str, tuple[str, dict[str, Any]]], runs: Sequence[str]) -> list[tuple[str, ...]]:
    """Runs that the same learning serves, with and without refinement; each other one alone."""
    from det2stoc_bayes.inference import get_method

    groups: dict[tuple[str, int | str], list[str]] = {}
    for run in runs:
        name, how = tasks[run]
        learns = hasattr(get_method(name), "refinements")
        groups.setdefault((name, how["seed"]) if learns else ("", run), []).append(run)
    return sorted((tuple(group) for group in groups.values()), key=len, reverse=True)  # what takes longest, first


def _drawn(
    source: "Study | Posed",
    tasks: Mapping[str, tuple[str, dict[str, Any]]],
    num_threads: int,
    progress: Callable[[str, int, int], None],
    runs: tuple[str, ...],
) -> "list[xarray.DataTree]":
    name, how = tasks[runs[0]]

    def pose() -> "Inferred":
        return make_problem(Simulator(source, how["engine"], num_threads)) if isinstance(source, Study) else source

    about = name, how["seed"], how["num_samples"], progress
    if len(runs) > 1:
        refines = [tasks[run][1].get("refine", "none") for run in runs]
        return _fitted(pose, *about, {"refines": refines}, by="refinements")
    options = {key: value for key, value in how.items() if key not in ("seed", "engine", "num_samples")}
    return [_fitted(pose, *about, options)]


def _silent(stage: str, done: int, total: int) -> None:
    """Progress within a task that another process does is not shown."""


def _kind(name: str) -> "Kind":
    """What a method's draws are."""
    from det2stoc_bayes.inference import EXACT, NO_POSTERIOR

    return "exact" if name in EXACT else "no posterior" if name in NO_POSTERIOR else "approximate"


def chosen_method(label: str, option: str) -> tuple[str, str, dict[str, str]]:
    """A label as it is, the method that it names, and that method's options; `option` is where it was given."""
    from det2stoc_bayes.inference import get_method

    name, plus, refine = (part.strip() for part in label.partition("+"))
    label = name + plus + refine
    known = inspect.signature(get_method(name, option).fit).parameters
    if not plus:
        return label, name, {}
    if "refine" not in known or refine != "psis":
        allowed = [name, *([f"{name}+psis"] if "refine" in known else [])]
        raise MethodNotApplicable(f"{option}: found '{label}'; allowed: {listing(allowed)}")
    return label, name, {"refine": refine}


def learned_simulator(fit: "xarray.DataTree") -> "StochasticSimulator":
    """The stochastic simulator that `det2stoc` or `baseline_cvae` learned, from the tree that `fit` returned or saved.

    `.sample(key, state, action)`, `.rollout`, `.save`; what states and actions consist of is in the group `simulator`.
    """
    from det2stoc_bayes.inference._predictive import learned

    return learned(fit)


def diagnose(
    study: Study,
    *,
    seed: int = 0,
    exact: bool = False,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> "Diagnosis":
    """What the believed model leaves out; `exact` draws the final posteriors by NUTS and compares the cheap way."""
    from det2stoc_bayes.mismatch.diagnose import diagnose as run

    sampler = None
    if exact:
        from det2stoc_bayes.inference.nuts import draw as sampler
    return run(study, seed=seed, progress=progress, temper=tempered, sampler=sampler)


def tempered(log_first: Any, log_target: Any, particles: "np.ndarray", seed: int) -> "np.ndarray":
    """Particles moved from one density to another by `inference.smc`, imported only where it is needed."""
    from det2stoc_bayes.inference.smc import temper

    moved = temper(log_first, log_target, particles, seed, target_ess=0.7, num_moves=15, num_last=1, max_stages=40)
    return moved.particles
