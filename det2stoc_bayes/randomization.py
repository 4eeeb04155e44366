"""A posterior as a domain-randomization set: draws of psi as a table, and as models that a simulator loads."""

import csv
import io
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.errors import Det2StocError, listing
from det2stoc_bayes.files import atomic_write, check_folder
from det2stoc_bayes.mismatch.patch import make_patch
from det2stoc_bayes.posterior import DataTree
from det2stoc_bayes.study import Study
from det2stoc_bayes.unknowns import of_population

TABLE = "psi.csv"
_MODEL = re.compile(r"model_\d+\.xml")


def draw_psi(
    study: Study, tree: DataTree, num_draws: int, random: np.random.Generator
) -> Float[np.ndarray, "draws psi"]:
    """psi of new episodes: of the posterior, and of its population where psi varies by recording.

    Draws are taken without replacement as long as there are enough. Det2StocError: a psi that the posterior lacks, or
    no draw.
    """
    if num_draws < 1:
        raise Det2StocError(f"num_draws: found {num_draws}; allowed: 1 or more")
    if "posterior" not in tree.children:
        raise Det2StocError(
            f"the fit by {tree.attrs.get('method')} infers no psi; allowed: a posterior, as laplace gives"
        )
    posterior = tree["posterior"].to_dataset()
    if not study.parameters or not {"chain", "draw"} <= set(posterior.sizes):
        lacks = "study.toml declares no psi" if not study.parameters else "the posterior has no draws"
        raise Det2StocError(f"{study.folder}: {lacks}; allowed: a study with psi, and a fit of it by det2stoc")
    total = posterior.sizes["chain"] * posterior.sizes["draw"]
    rows = random.choice(total, num_draws, replace=num_draws > total)

    def column(name: str) -> Float[np.ndarray, " draws"]:
        if name not in posterior:
            found = ", ".join(map(str, posterior.data_vars))
            raise Det2StocError(f"the posterior has no psi '{name}', which study.toml declares; it has {found}")
        if set(posterior[name].dims) != {"chain", "draw"}:
            raise Det2StocError(
                f"psi '{name}' of the posterior varies by recording, in study.toml it does not; "
                "allowed: a fit of this study"
            )
        values = np.asarray(posterior[name].values, float).reshape(total)[rows]
        if not np.isfinite(values).all():
            raise Det2StocError(f"psi '{name}' of the posterior has draws that are not finite; allowed: finite numbers")
        return values

    columns = []
    for p in study.parameters:
        if p.varies == "trajectory":
            z = random.standard_normal(num_draws)
            columns.append(np.asarray(of_population(p, column(f"{p.name}_mu"), column(f"{p.name}_sigma"), z)))
        else:
            columns.append(column(p.name))
    return np.stack(columns, 1)


def export(
    study: Study,
    tree: DataTree,
    out: str | os.PathLike[str],
    *,
    num_draws: int,
    seed: int = 0,
    models: bool = True,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> list[Path]:
    """Writes psi.csv, one row a draw, and with `models` an MJCF a row, their assets beside them.

    Det2StocError: what MJCF cannot say of a psi (then without `models`), or a posterior of another study.
    """
    check_folder(Path(out))
    folder, psi = Path(out), draw_psi(study, tree, num_draws, np.random.default_rng(seed))
    names = [p.name for p in study.parameters]
    width = len(str(num_draws))
    files = [f"model_{i + 1:0{width}d}.xml" if models else "" for i in range(num_draws)]
    texts: dict[Path, str | bytes] = {}
    assets: Mapping[str, Path] = {}
    for i, row in enumerate(psi if models else ()):
        values = dict(zip(names, map(float, row), strict=True))
        patch = make_patch(study, values)
        if patch.unsaid:
            told = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
            raise Det2StocError(
                f"{study.folder}: draw {i + 1}, {told}: MJCF does not take {listing(patch.unsaid)}, as an inertia "
                "that no solid has; allowed: --no-models, for the table alone"
            )
        texts[folder / files[i]] = patch.model
        assets = patch.assets
        progress(i + 1, num_draws)
    texts |= {folder / name: file.read_bytes() for name, file in assets.items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["model", *names] if models else names)
    for name, row in zip(files, psi, strict=True):
        writer.writerow([*([name] if models else []), *(repr(float(v)) for v in row)])
    earlier = _models_of(folder / TABLE)
    (folder / TABLE).unlink(missing_ok=True)
    for path, content in texts.items():
        atomic_write(path, content)
    for path in earlier - set(texts):
        path.unlink(missing_ok=True)
    atomic_write(folder / TABLE, text.getvalue())  # last: where it is, all is
    return [*texts, folder / TABLE]


def _models_of(table: Path) -> set[Path]:
    """The models that an earlier export wrote, by its table; nothing else in the folder is its own."""
    try:
        with table.open(encoding="utf-8", newline="") as file:
            named = {row.get("model") or "" for row in csv.DictReader(file)}
    except (OSError, UnicodeDecodeError, csv.Error):
        return set()
    return {table.parent / name for name in named if _MODEL.fullmatch(name)}
