"""Posteriors over simulator parameters, and the physics that a simulator leaves out.

`load(folder)` reads a study, `check(study)` says what its recordings can identify, `fit(study)` gives the
posterior, `compare(study, methods, folder)` several beside each other, `calibrate(problem, method, folder)` tests
whether a method's hold the truth, `export(study, posterior, folder, num_draws=100)` writes models with draws of one,
`diagnose(study)` finds what the believed model leaves out. `import_study(format, source, folder, model=...)`,
`fetch_study(name, folder)` and `export_sysid(study, folder)` bring recordings in and out.
`learned_simulator(posterior)` is the `StochasticSimulator` that an amortized method learned; `StochasticEnv` makes a
Gymnasium environment of it. Every error that a user can act on is a `Det2StocError`.
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
    from det2stoc_bayes.importers.importing import import_study
    from det2stoc_bayes.importers.public.fetch import fetch_study
    from det2stoc_bayes.importers.sysid_export import export_sysid
    from det2stoc_bayes.inference._environment import StochasticEnv
    from det2stoc_bayes.inference._stochastic import StochasticSimulator
    from det2stoc_bayes.randomization import export
    from det2stoc_bayes.study import load_study as load
    from det2stoc_bayes.verbs import compare, diagnose, fit, learned_simulator
    from det2stoc_bayes.verbs_calibrate import calibrate

# Looked up at first use, so that `import det2stoc_bayes` and `det2stoc --help` wait for no library.
_LAZY = {
    "StochasticEnv": "det2stoc_bayes.inference._environment:StochasticEnv",
    "StochasticSimulator": "det2stoc_bayes.inference._stochastic:StochasticSimulator",
    "calibrate": "det2stoc_bayes.verbs_calibrate:calibrate",
    "check": "det2stoc_bayes.identifiability:check",
    "compare": "det2stoc_bayes.verbs:compare",
    "diagnose": "det2stoc_bayes.verbs:diagnose",
    "export": "det2stoc_bayes.randomization:export",
    "export_sysid": "det2stoc_bayes.importers.sysid_export:export_sysid",
    "fetch_study": "det2stoc_bayes.importers.public.fetch:fetch_study",
    "fit": "det2stoc_bayes.verbs:fit",
    "import_study": "det2stoc_bayes.importers.importing:import_study",
    "learned_simulator": "det2stoc_bayes.verbs:learned_simulator",
    "load": "det2stoc_bayes.study:load_study",
}

__all__ = [
    "Det2StocError",
    "EngineError",
    "MethodNotApplicable",
    "ModelError",
    "SimulationDiverged",
    "StochasticEnv",
    "StochasticSimulator",
    "StudyError",
    "calibrate",
    "check",
    "compare",
    "diagnose",
    "export",
    "export_sysid",
    "fetch_study",
    "fit",
    "import_study",
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
