"""What the recordings of a data set are known by, so that a fetch can tell other files, and a converter that erred.

    python -m det2stoc_bayes.importers.public.fingerprints STUDY ... > fingerprints.json

A recording's fingerprint is its number of samples and, of each column, two sums over the samples: of the values, and of
the values times the sample's place, which tells samples that changed places.
"""

import csv
import json
import sys
from collections.abc import Mapping
from importlib.resources import files as resources
from pathlib import Path
from typing import Any

import numpy as np

from det2stoc_bayes.importers.write import Table

TOLERANCE = 1e-7  # of the sum of sizes; rounding to nine digits leaves 1e-9 at most


def fingerprint(table: Table) -> dict[str, Any]:
    """Samples, and two sums a column."""
    place = np.arange(1, len(table.rows) + 1) / len(table.rows)
    sums = {c: [float(v.sum()), float((place * v).sum())] for c, v in zip(table.header, table.rows.T, strict=True)}
    return {"samples": len(table.rows), "columns": {c: [round(x, 9) for x in both] for c, both in sums.items()}}


def known(name: str) -> dict[str, Any]:
    """Recording (with its folder) -> fingerprint of a data set."""
    text = (resources("det2stoc_bayes.importers.public") / "fingerprints.json").read_text(encoding="utf-8")
    return json.loads(text)[name]


def differences(tables: Mapping[str, Table], expected: Mapping[str, Any]) -> list[str]:
    """What is not as expected, a line a recording."""
    found = [f"no {name}" for name in expected if name not in tables]
    found += [f"{name}, which is not known" for name in tables if name not in expected]
    for name in tables.keys() & expected.keys():
        table, told = tables[name], expected[name]
        if len(table.rows) != told["samples"]:
            found.append(f"{name}: {len(table.rows)} samples, known are {told['samples']}")
            continue
        if list(table.header) != list(told["columns"]):
            found.append(f"{name}: other columns")
            continue
        sums, sizes = fingerprint(table)["columns"], np.abs(table.rows).sum(axis=0)
        for (column, both), size in zip(sums.items(), sizes, strict=True):
            off = max(abs(a - b) for a, b in zip(both, told["columns"][column], strict=True))
            if off > TOLERANCE * size + 1e-9 * len(table.rows):
                found.append(f"{name}: {column} is off by {off / len(table.rows):.2g} on average")
                break
    return sorted(found)


def of_study(folder: Path) -> dict[str, Any]:
    """The fingerprints of a study's recordings."""
    found = {}
    for path in sorted([*folder.glob("recordings/*.csv"), *folder.glob("holdout/*.csv")]):
        with path.open(newline="") as file:
            header, *rows = csv.reader(file)
        found[f"{path.parent.name}/{path.stem}"] = fingerprint(Table(tuple(header), np.array(rows, float)))
    return found


if __name__ == "__main__":
    every = {Path(folder).name: of_study(Path(folder)) for folder in sys.argv[1:]}
    print("{")
    for n, (study, recordings) in enumerate(every.items()):
        lines = [f"  {json.dumps(name)}: {json.dumps(told)}" for name, told in recordings.items()]
        print(f" {json.dumps(study)}: {{\n" + ",\n".join(lines) + "\n }" + ("," if n + 1 < len(every) else ""))
    print("}")
