"""Posteriors over simulator parameters, and the physics that a simulator leaves out.

`load(folder)` reads a study, `check(study)` says what its recordings can identify, `fit(study)` gives the
posterior, `export(study, posterior, folder, num_draws=100)` writes models with draws of it, `diagnose(study)` finds
what the believed model leaves out. `learned_simulator(posterior)` is the stochastic simulator that an amortized
method learned. Every error that a user can act on is a `Det2StocError`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from det2stoc_bayes.errors import (
    Det2StocError,
    EngineError,
    MethodNotApplicable,
    ModelError,
    SimulationDiverged,
    StudyError,
)

if TYPE_CHECKING:
    from det2stoc_bayes.identifiability import check
    from det2stoc_bayes.randomization import export
    from det2stoc_bayes.study import load_study as load
    from det2stoc_bayes.verbs import diagnose, fit, learned_simulator

# Looked up at first use, so that `import det2stoc_bayes` and `det2stoc --help` wait for no library.
_LAZY = {
    "check": "det2stoc_bayes.identifiability:check",
    "diagnose": "det2stoc_bayes.verbs:diagnose",
    "export": "det2stoc_bayes.randomization:export",
    "fit": "det2stoc_bayes.verbs:fit",
    "learned_simulator": "det2stoc_bayes.verbs:learned_simulator",
    "load": "det2stoc_bayes.study:load_study",
}

__all__ = [
    "Det2StocError",
    "EngineError",
    "MethodNotApplicable",
    "ModelError",
    "SimulationDiverged",
    "StudyError",
    "check",
    "diagnose",
    "export",
    "fit",
    "learned_simulator",
    "load",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("det2stoc-bayes")
    if name not in _LAZY:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module, _, attribute = _LAZY[name].partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
