"""A tensor in a file of torch.save, without PyTorch and without trusting the file.

Such a file is a zip archive of raw numbers and of a pickle that says how they are laid out. A pickle may name any
function to be called; here it may name the few that lay out a tensor, and each of them is one of this module.
"""

import io
import math
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from det2stoc_bayes.importers.base import SourceError

_TYPES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "LongStorage": "<i8", "IntStorage": "<i4"}
MOST_BYTES = 100_000_000


class _Storage:
    """The name under which a pickle refers to numbers of one type."""

    def __init__(self, dtype: str) -> None:
        self.dtype = dtype


def _rebuild_tensor(
    storage: np.ndarray, offset: int, size: Sequence[int], stride: Sequence[int], *_: Any
) -> np.ndarray:
    """What torch._utils._rebuild_tensor_v2 does, within the numbers that the file has."""
    whole = (offset, *size, *stride)
    if not all(isinstance(n, int) and n >= 0 for n in whole) or len(size) != len(stride):
        raise pickle.UnpicklingError("a tensor of no shape")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if math.prod(size) and last >= len(storage):
        raise pickle.UnpicklingError("a tensor beyond the file's numbers")
    places = np.full((), offset)
    for n, step in zip(size, stride, strict=True):
        places = places[..., None] + step * np.arange(n)
    return storage[places] if math.prod(size) else np.zeros(tuple(size))


class _Reader(pickle.Unpickler):
    """Unpickles a tensor's layout and nothing else."""

    def __init__(self, file: io.BytesIO, archive: zipfile.ZipFile, root: str) -> None:
        super().__init__(file)
        self.archive, self.root = archive, root

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _rebuild_tensor
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module == "torch" and name in _TYPES:
            return _Storage(_TYPES[name])
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")

    def persistent_load(self, pid: Any) -> np.ndarray:
        if not (isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage" and isinstance(pid[1], _Storage)):
            raise pickle.UnpicklingError("it refers to something that is no storage")
        raw = _member(self.archive, f"{self.root}/data/{pid[2]}")
        return np.frombuffer(raw, pid[1].dtype)


def read_tensor(path: Path) -> np.ndarray:
    """The one tensor of a file, as floats. SourceError for any other file, and for a pickle that wants more."""
    try:
        with zipfile.ZipFile(path) as archive:
            layouts = [name for name in archive.namelist() if name.endswith("/data.pkl") and name.count("/") == 1]
            if len(layouts) != 1:
                raise pickle.UnpicklingError("no data.pkl in it")
            root = layouts[0].removesuffix("/data.pkl")
            order = f"{root}/byteorder"
            if order in archive.namelist() and _member(archive, order).strip() != b"little":
                raise pickle.UnpicklingError("its numbers are not little-endian")
            found = _Reader(io.BytesIO(_member(archive, layouts[0])), archive, root).load()
    except (zipfile.BadZipFile, pickle.UnpicklingError, KeyError, ValueError, IndexError, EOFError, TypeError,
            AttributeError, OverflowError, OSError) as error:  # fmt: skip
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SourceError(f"{path.name}: refused: {reason}; allowed: a file of torch.save with one tensor") from error
    if not isinstance(found, np.ndarray):
        raise SourceError(f"{path.name}: found a {type(found).__name__}; allowed: one tensor")
    return found.astype(float)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    if archive.getinfo(name).file_size > MOST_BYTES:
        raise pickle.UnpicklingError(f"{name} is larger than {MOST_BYTES / 1e6:g} MB")
    return archive.read(name)
