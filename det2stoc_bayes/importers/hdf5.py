"""What the formats that are HDF5 files share: numeric arrays, a row a sample, as signals."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.importers.base import Signal, SourceError, numbers

MOST_WIDTH = 512  # numbers a row: more are pictures
Clock = Callable[[int], Float[np.ndarray, " samples"]]  # the times of so many rows


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """The file, or a SourceError."""
    if not path.is_file():
        raise SourceError(f"{path}: no such file; allowed: an HDF5 file")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        reason = " ".join(str(error).split())
        raise SourceError(f"{path.name}: cannot be read: {reason}; allowed: an HDF5 file") from error
    with file:
        yield file


def signals(item: object, name: str, clock: Clock, where: str) -> Iterator[tuple[str, Signal]]:
    """`name/<key>/<index>` of every number of every row below an item; pictures and text are passed over."""
    if isinstance(item, h5py.Group):
        for key, child in item.items():
            yield from signals(child, f"{name}/{key}", clock, where)
        return
    if not isinstance(item, h5py.Dataset):
        return
    picture = item.ndim == 2 and item.shape[1] > MOST_WIDTH
    if item.ndim not in (1, 2) or picture or not np.issubdtype(item.dtype, np.number):
        return
    values = numbers(item[()], f"{where}: {name}")
    time = clock(len(values))
    if values.ndim == 1:
        yield name, Signal(time, values, None, name)
    else:
        for i in range(values.shape[1]):
            yield f"{name}/{i}", Signal(time, values[:, i])


def evenly(period: float, first: int = 0) -> Clock:
    """A row a period, the first after so many of them."""
    return lambda rows: period * np.arange(first, first + rows)


def height(item: object) -> int:
    """How many rows the arrays below an item have: the first's."""
    while isinstance(item, h5py.Group):
        item = next(iter(item.values()), None)
    return len(item) if isinstance(item, h5py.Dataset) and item.ndim else 0


def episodes(group: h5py.Group, prefix: str) -> list[str]:
    """The names in a group that begin so, by the numbers at their ends."""
    names = [str(name) for name in group if str(name).startswith(prefix)]
    return sorted(names, key=lambda name: (int("".join(c for c in name if c.isdigit()) or 0), name))
