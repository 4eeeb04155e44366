"""Recordings of other formats as studies. Every module here that FORMATS names reads one format; see `base`."""

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, cast

from det2stoc_bayes.suggestions import choices

if TYPE_CHECKING:
    from det2stoc_bayes.importers.base import Format

# Name -> module. They are imported when they are asked for, since each brings libraries of its own.
FORMATS: Mapping[str, str] = {
    module.removesuffix("_columns"): f"det2stoc_bayes.importers.{module}"
    for module in ("bam", "csv_columns", "lerobot", "mcap", "minari", "robomimic", "sysid")
}


def get_format(name: str) -> "Format":
    """The module that reads a format; SourceError for one that none reads."""
    from det2stoc_bayes.importers.base import SourceError

    if name not in FORMATS:
        raise SourceError(f"FORMAT: found '{name}'; {choices(name, (*FORMATS, 'urdf'))}")
    return cast("Format", import_module(FORMATS[name]))
