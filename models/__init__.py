"""Systems by name: one module a system; those that pose an inference problem have `record(folder)`.

It writes the problem as a study's folder. A module whose posterior is known has `closed_form(problem)`, too. Problems
of vectors, which are no studies, are a `PROBLEM`: for calibration and benchmarks, and to compare methods on where they
have an observation of their own.
"""

from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from det2stoc_bayes.errors import Det2StocError, listing
from det2stoc_bayes.suggestions import choices

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from det2stoc_bayes.problem import Problem
    from det2stoc_bayes.vector_problem import Posed, VectorProblem

    type Gaussian = tuple[Float[np.ndarray, " size"], Float[np.ndarray, "size size"]]

# Told here, since to look for them would import them all; a test compares.
PROBLEMS = ("cartpole", "linear_gaussian", "pendulum")  # with `record`
VECTORS = ("gaussian_linear", "slcp", "trivariate", "two_moons", "windy_slope")  # with `PROBLEM`
POSED = ("trivariate", "windy_slope")  # of these, what has an observation of its own: to compare methods on
MODELS: tuple[str, ...] = tuple(sorted(m.name for m in iter_modules(__path__) if not m.name.startswith("_")))


def no_study(name: str) -> Det2StocError:
    """That a problem has no recordings to fit."""
    run_by = "`det2stoc compare` and" if name in POSED else "`make compare-sbi` and"
    said = f"{name}: is a problem of vectors, which has no recordings: {run_by} `det2stoc calibrate` run it"
    return Det2StocError(f"{said}; allowed here: a study's folder, {listing(PROBLEMS)}")


def vector_problem(name: str) -> "VectorProblem":
    """A problem of VECTORS."""
    return import_module(f"{__name__}.{name}").PROBLEM


def record(name: str, folder: Path) -> Path:
    """A system's own problem as a study in a folder; a Det2StocError lists the problems where none has this name."""
    if name in VECTORS:
        raise no_study(name)
    if name not in PROBLEMS:
        raise Det2StocError(f"problem: unknown problem '{name}'; {choices(name, PROBLEMS, limit=20)}")
    return import_module(f"{__name__}.{name}").record(folder)


def get_problem(name: str, *, engine: str = "c", num_threads: int = 0) -> "Problem":
    """The same as a problem, without a folder that stays."""
    from det2stoc_bayes.problem import make_problem
    from det2stoc_bayes.simulator import Simulator
    from det2stoc_bayes.study import load_study

    with TemporaryDirectory() as folder:
        return make_problem(Simulator(load_study(record(name, Path(folder) / name)), engine, num_threads))


def posed(name: str, engine: str = "c") -> "Posed":
    """A problem of POSED with its observation."""
    from det2stoc_bayes.vector_problem import Posed

    problem = vector_problem(name)
    if (x := problem.observed) is None:
        raise Det2StocError(f"{name}: has no observation of its own; allowed: {listing(POSED)}")
    return Posed(problem, x, engine=engine)


def closed_form(name: str, problem: "Problem | Posed") -> "Gaussian | None":
    """Mean and covariance of the unknowns' posterior where it is a Gaussian that is known; None of other problems."""
    found = getattr(import_module(f"{__name__}.{name}"), "closed_form", None)
    return None if found is None else found(problem)
