"""Experiments of the source work, run again: one module an experiment, each with `run` and `page`."""

from importlib import import_module
from types import ModuleType

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.suggestions import choices

# Name on the command line -> module.
EXPERIMENTS = {"trivariate": "trivariate", "windy-slope": "windy_slope", "yumi-pusher": "yumi_pusher"}


def get_experiment(name: str) -> ModuleType:
    """An experiment's module, imported now; a Det2StocError lists the experiments where none has this name."""
    if name not in EXPERIMENTS:
        raise Det2StocError(f"reproduce: unknown experiment '{name}'; {choices(name, tuple(EXPERIMENTS), limit=20)}")
    return import_module(f"{__name__}.{EXPERIMENTS[name]}")
