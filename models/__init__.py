"""Systems by name: one module a system; those that pose an inference problem have `pose(*, engine, num_threads)`."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.suggestions import choices

if TYPE_CHECKING:
    from det2stoc_bayes.problem import Problem

MODELS: tuple[str, ...] = tuple(sorted(m.name for m in iter_modules(__path__) if not m.name.startswith("_")))


def problems() -> tuple[str, ...]:
    """Names of the modules that pose a problem, none of which is imported for it."""
    return tuple(name for name in MODELS if "\ndef pose(" in _source(name))


def get_problem(name: str, *, engine: str = "c", num_threads: int = 0) -> "Problem":
    """A system's own problem; a Det2StocError lists the problems where none has this name."""
    if name not in (known := problems()):
        raise Det2StocError(f"problem: unknown problem '{name}'; {choices(name, known, limit=20)}")
    return import_module(f"{__name__}.{name}").pose(engine=engine, num_threads=num_threads)


def _source(name: str) -> str:
    spec = find_spec(f"{__name__}.{name}")
    return Path(spec.origin).read_text("utf-8") if spec and spec.origin else ""
