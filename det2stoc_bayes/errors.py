"""One tree of errors. A message says what is wrong, where, what was found and what is allowed."""

from collections.abc import Iterable


class Det2StocError(Exception):
    """Base of every error that a user can act on; the command line prints it and exits with 2."""


class StudyError(Det2StocError):
    """Something in a study's files is wrong."""


class ModelError(Det2StocError):
    """The MJCF does not compile, or does not have what is asked of it."""


class EngineError(Det2StocError):
    """An engine cannot simulate this model faithfully."""


class SimulationDiverged(Det2StocError):
    """No simulation of the believed model stays finite."""


class MethodNotApplicable(Det2StocError):
    """An inference method needs something that the problem lacks."""


class SamplingFailed(Det2StocError):
    """A sampler did not reach its target."""


def listing(names: Iterable[str], limit: int = 12) -> str:
    """Names for an error message, cut after `limit`."""
    names = list(names)
    shown = ", ".join(names[:limit]) or "none"
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"
