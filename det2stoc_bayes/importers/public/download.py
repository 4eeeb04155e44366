"""Files of a public repository at a pinned commit: from GitHub, or from a mirror that is laid out alike."""

import json
import logging
import shutil
from collections.abc import Callable, Mapping
from importlib.resources import files as resources
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from det2stoc_bayes.files import atomic_write
from det2stoc_bayes.importers.base import SourceError
from det2stoc_bayes.importers.public.base import Dataset
from det2stoc_bayes.importers.write import sha256

PUBLIC = "https://raw.githubusercontent.com"
LOCK = "sha256.json"  # in the cache: what each file was when it was first fetched


def known_checksums() -> dict[str, str]:
    """Address (OWNER/REPO/COMMIT/PATH) -> SHA-256 of the files that this package knows before they are fetched."""
    text = (resources("det2stoc_bayes.importers.public") / "sha256.json").read_text(encoding="utf-8")
    return json.loads(text)


def download(
    data: Dataset,
    mirror: str | None,
    into: Path,
    *,
    unverified: bool = False,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> tuple[dict[str, Path], dict[str, str], int]:
    """Every file of a data set by its path, its checksum, and how many checksums were known before.

    From the network they are kept in the user's cache, and held against the checksums that `lock` wrote there; from a
    mirror they are copied to `into`. SourceError: no network, no such file, or another content (unless `unverified`).
    """
    base = f"{data.repository}/{data.commit}"
    cache = into if mirror is not None else _cache() / base
    known = known_checksums()
    shipped = {path: sum_ for path in data.files if (sum_ := known.get(f"{base}/{path}"))}
    expected = (_read_lock(cache / LOCK) if mirror is None else {}) | shipped
    found: dict[str, Path] = {}
    sums: dict[str, str] = {}
    for done, path in enumerate(data.files):
        progress(f"fetching {data.name}", done, len(data.files))
        name = path.replace("/", "_")
        wanted = None if unverified else expected.get(path)
        found[path] = _one(f"{base}/{path}", mirror, cache / name, wanted)
        sums[path] = sha256(found[path])
        if path in expected and sums[path] != expected[path] and not unverified:
            raise SourceError(f"{path}: found SHA-256 {sums[path]}; allowed: {expected[path]} (or --unverified)")
    progress(f"fetching {data.name}", len(data.files), len(data.files))
    return found, sums, len(expected)


def lock(data: Dataset, sums: Mapping[str, str]) -> None:
    """Remember what the files of a data set are, once its recordings have proved right."""
    atomic_write(_cache() / data.repository / data.commit / LOCK, json.dumps(dict(sums), indent=1))


def forget(data: Dataset) -> None:
    """Remove a data set's files from the cache, so that they are downloaded anew."""
    shutil.rmtree(_cache() / data.repository / data.commit, ignore_errors=True)


def _cache() -> Path:
    import pooch

    return Path(pooch.os_cache("det2stoc-bayes"))


def _read_lock(path: Path) -> dict[str, str]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _one(address: str, mirror: str | None, place: Path, expected: str | None) -> Path:
    """One file at its place."""
    local = _local(mirror)
    if local is not None:
        if not (local / address).is_file():
            raise SourceError(f"--mirror {mirror}: no {address}; allowed: a folder with OWNER/REPO/COMMIT/PATH")
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(local / address, place)
        return place
    import pooch
    import requests

    url = f"{(mirror or PUBLIC).rstrip('/')}/{quote(address)}"
    logging.getLogger("pooch").setLevel(logging.ERROR)
    try:
        pooch.retrieve(url, None if expected is None else f"sha256:{expected}", place.name, place.parent)
    except requests.HTTPError as error:  # as 404
        raise SourceError(f"{url}: {str(error)[:60]}; allowed: a file that is there") from error
    except (requests.RequestException, OSError) as error:
        reason = "no network" if isinstance(error, requests.ConnectionError) else " ".join(str(error).split())[:200]
        raise SourceError(f"{url}: cannot be downloaded ({reason}); allowed: a connection, or --mirror DIR with "
                          f"{address}") from error  # fmt: skip
    except ValueError as error:  # pooch's, of a checksum
        raise SourceError(f"{url}: found another content than SHA-256 {expected}; allowed: the pinned one") from error
    return place


def _local(mirror: str | None) -> Path | None:
    """A mirror that is a folder; None for a URL."""
    if mirror is None or mirror.startswith(("http://", "https://")):
        return None
    folder = Path(unquote(urlsplit(mirror).path)) if mirror.startswith("file://") else Path(mirror)
    if not folder.is_dir():
        raise SourceError(f"--mirror {mirror}: no such folder; allowed: a folder, or a URL of http, https or file")
    return folder
