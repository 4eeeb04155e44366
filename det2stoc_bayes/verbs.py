"""Commands as functions that return objects, where one is more than a call. The frame never imports this."""

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import Study

if TYPE_CHECKING:
    import xarray


def fit(
    study: Study,
    method: str = "nuts",
    *,
    seed: int = 0,
    engine: str = "c",
    num_samples: int = 1000,
    progress: Callable[[str, int, int], None] | None = None,
    **options: Any,
) -> "xarray.DataTree":
    """The posterior of psi by a method of `det2stoc_bayes.inference`; `options` are the method's own."""
    from det2stoc_bayes.inference import get_method

    run = get_method(method).fit
    if progress is not None and "progress" in inspect.signature(run).parameters:
        options["progress"] = lambda done, total: progress("sampling", done, total)
    problem = make_problem(Simulator(study, engine))
    return run(problem, seed, num_samples=num_samples, **options)
