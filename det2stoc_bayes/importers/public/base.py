"""What a data set is: files of a public repository at a pinned commit, and how they become a study."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from det2stoc_bayes.importers.base import SourceError
from det2stoc_bayes.importers.public import NAMES
from det2stoc_bayes.importers.write import Table
from det2stoc_bayes.suggestions import choices

DIGITS = 9  # of every number in a recording


@dataclass(frozen=True, eq=False)
class Converted:
    """The recordings of a data set, and study.toml's text (which may depend on the files, as known masses do)."""

    recordings: Mapping[str, Table]
    holdout: Mapping[str, Table]
    study: str


@dataclass(frozen=True, eq=False)
class Dataset:
    """`files`: paths in the repository, at `commit`. `convert` gets them by path. `source`: SOURCE.md's text."""

    name: str
    repository: str
    commit: str
    files: Sequence[str]
    license: str
    model: str
    source: str
    convert: Callable[[Mapping[str, Path]], Converted]


def get_dataset(name: str) -> Dataset:
    """A data set by its name."""
    if name not in NAMES:
        raise SourceError(f"NAME: found '{name}'; {choices(name, NAMES)}")
    return import_module(f"det2stoc_bayes.importers.public.{name}").DATASET
