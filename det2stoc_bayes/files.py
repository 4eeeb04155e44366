"""Outputs appear whole or not at all: written beside their place, then moved there in one step."""

import json
import os
import secrets
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from det2stoc_bayes.errors import Det2StocError


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what was written there takes its place on success.

    For writers that want a path, as `DataTree.to_netcdf`. After an error or Ctrl-C the old file stands
    and the temporary one is gone. The suffix is kept, since some writers look at it.
    """
    target = Path(path)
    temporary = target.with_name(f".{secrets.token_hex(6)}.{target.name}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise unwritable(target, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def check_folder(out: Path, *files: str) -> None:
    """A folder for results that cannot be one, or cannot take these files: a Det2StocError before the work."""
    new = [path for path in (out, *out.parents) if not path.exists()]
    there = (out, *out.parents)[len(new)]  # the root exists, and the working folder
    if not there.is_dir():
        raise Det2StocError(f"--out {out}: {there} is a file; allowed: a folder, or a new name")
    check_files(out / name for name in files)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise unwritable(out, error) from error
    finally:
        with suppress(OSError):
            for path in new:
                path.rmdir()


def check_files(paths: Iterable[Path]) -> None:
    """Places for files that folders have are a Det2StocError before the work."""
    for path in paths:
        if path.is_dir():
            raise Det2StocError(f"{path}: found a folder in the place of a file; allowed: another --out, or to move it")


def check_kept(places: Iterable[Path], read: Iterable[Path]) -> None:
    """Places for files where something stands that is read are a Det2StocError before the work."""
    kept = {path.resolve() for path in read}
    for path in places:
        if path.resolve() in kept:
            raise Det2StocError(f"{path}: is read by the study, and would be overwritten; allowed: another --out")


def unwritable(path: Path, error: OSError) -> Det2StocError:
    """That a file or folder cannot be written, and why."""
    reason = error.strerror or " ".join(str(error).split())
    return Det2StocError(f"{path}: cannot be written ({reason}); allowed: a place with room and the right to write")


def atomic_write(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write text (UTF-8, line ends as given) or bytes to `path`, whole or not at all."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    with replacing(path) as temporary, open(temporary, "xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def write_all(folder: str | os.PathLike[str], files: Mapping[str, bytes]) -> Path:
    """Write files by their path in a new folder, which it gives."""
    for name, content in files.items():
        path = Path(folder) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return Path(folder)


@contextmanager
def appending(
    path: str | os.PathLike[str],
) -> Iterator[tuple[list[dict[str, Any]], Callable[[Mapping[str, Any]], None]]]:
    """The JSON lines that a file has, and what appends one; a line that was cut off is removed first."""
    path = Path(path)
    text = path.read_text("utf-8", errors="replace") if path.is_file() else ""
    lines = []
    for line in text.splitlines():
        with suppress(json.JSONDecodeError):
            found = json.loads(line)
            lines += [found] if isinstance(found, dict) else []
    whole = "".join(json.dumps(line) + "\n" for line in lines)
    if whole != text:
        atomic_write(path, whole)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a", encoding="utf-8")
    except OSError as error:
        raise unwritable(path, error) from error

    def append(line: Mapping[str, Any]) -> None:
        try:
            file.write(json.dumps(line) + "\n")
            file.flush()
        except OSError as error:
            raise unwritable(path, error) from error

    with file:
        yield lines, append
