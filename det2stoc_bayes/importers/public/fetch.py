"""A public data set as a study: `det2stoc fetch`."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import SourceError
from det2stoc_bayes.importers.public.base import DIGITS, Dataset, get_dataset
from det2stoc_bayes.importers.public.download import download, forget, lock
from det2stoc_bayes.importers.public.fingerprints import differences, known
from det2stoc_bayes.importers.write import staged, write_study

MOST_TOLD = 3


@dataclass(frozen=True)
class Fetched:
    """What was fetched: files with their checksums, recordings' names, and what was checked, in words."""

    files: Mapping[str, str]
    recordings: Sequence[str]
    checked: str


def fetch_study(
    name: str,
    out: Path,
    *,
    mirror: str | None = None,
    unverified: bool = False,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Fetched:
    """Download, check, convert and write a data set of `public`, whole or not at all.

    `mirror`: a folder or base URL that holds OWNER/REPO/COMMIT/PATH. SourceError: no network, or recordings that are
    not those that the package knows the fingerprints of (unless `unverified`).
    """
    data, out = get_dataset(name), Path(out)
    with staged(out) as folder, tempfile.TemporaryDirectory() as scratch:
        files, sums, num_known = download(data, mirror, Path(scratch), unverified=unverified, progress=progress)
        made = data.convert(files)
        tables = {f"recordings/{n}": t for n, t in made.recordings.items()}
        tables |= {f"holdout/{n}": t for n, t in made.holdout.items()}
        wrong = differences(tables, known(name))
        if wrong and not unverified:
            if mirror is None:
                forget(data)
            raise SourceError(
                f"{name}: the recordings are not those of the pinned commit: {listing(wrong, MOST_TOLD)}; "
                "allowed: those whose fingerprints this version knows (or --unverified)"
            )
        checked = f"{num_known} known checksums, "
        checked += "not the known recordings" if wrong else f"all {len(tables)} recordings as known"
        texts = {"model.xml": data.model, "study.toml": made.study, "SOURCE.md": _source(data, sums, checked)}
        written = {path: text.encode() for path, text in texts.items()}
        write_study(folder, out, written, made.recordings, made.holdout, name, DIGITS)
        if mirror is None and not wrong:
            lock(data, sums)
    return Fetched(sums, tuple(tables), checked)


def _source(data: Dataset, sums: Mapping[str, str], checked: str) -> str:
    lines = [f"# {data.name}", "", data.source, "", f"- Source: github.com/{data.repository}, commit {data.commit}",
             f"- Licence: {data.license}",
             f"- Written by `det2stoc fetch {data.name}`, version {version('det2stoc-bayes')}; checked: {checked}.",
             "- Files, with their SHA-256 as fetched:",
             *(f"  - {path}: {s}" for path, s in sums.items()), ""]  # fmt: skip
    return "\n".join(lines)
