"""Inference methods by name: one module a method, each with `fit(problem, key, *, ...) -> DataTree`.

A method that learns once and then infers from any recordings of a kind also has `train(problem, key, *, ...)`, whose
result can be pickled, and `apply(trained, problem, key, *, num_samples, ...) -> DataTree`; and
`refinements(problem, key, refines, *, ...)`, which learns once for results with and without refinement.
"""

from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

import numpyro

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.suggestions import choices

_ = numpyro.__version__  # ArviZ leaves a lazy stand-in, which has to become NumPyro before parts of it are imported
METHODS: tuple[str, ...] = tuple(sorted(m.name for m in iter_modules(__path__) if not m.name.startswith("_")))
EXACT = ("blackjax_nuts", "emcee", "nuts", "smc")  # whose draws are those of the posterior once they have converged
NO_POSTERIOR = ("baseline_cvae", "population_search")  # the one predicts, the other seeks a population


def get_method(name: str, option: str = "method") -> ModuleType:
    """A method's module, imported now; a Det2StocError lists the methods where none has this name.

    `option` is what it was given as.
    """
    if name not in METHODS:
        raise Det2StocError(f"{option}: unknown method '{name}'; {choices(name, METHODS, limit=20)}")
    return import_module(f"{__name__}.{name}")
