"""Cases that conceal something in a scene of the project's, each diagnosed by a process that sees its study alone."""

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from logs import append
from real import diagnosed

from det2stoc_bayes.files import write_all

FREE_Q, FREE_V = ("x", "y", "z", "qw", "qx", "qy", "qz"), ("vx", "vy", "vz", "wx", "wy", "wz")
FILES = """model = "model.xml"
recordings = "recordings/*.csv"
holdout = "holdout/*.csv"
"""
Law = Callable[[mujoco.MjModel], Callable[[mujoco.MjData], None]]  # prepares a model; what to do before each step
Case = tuple[Law | None, str, str]  # what is concealed, its name and element


def write(
    folder: Path,
    model: Path,
    study: str,
    columns: Sequence[str],
    recordings: Mapping[str, Float[np.ndarray, "samples columns"]],
) -> Path:
    """A study's files: each recording, time first, by its place without `.csv`; returns the folder."""
    files = {"model.xml": model.read_bytes(), "study.toml": study.encode()}
    for stem, values in recordings.items():
        rows = (",".join(f"{v:.9g}" for v in row) for row in values)
        files[f"{stem}.csv"] = "\n".join([",".join(("time", *columns)), *rows, ""]).encode()
    return write_all(folder, files)


def conceal(
    about: str | None,
    cases: Mapping[str, Case],
    usual: Sequence[str],
    log: Path,
    make: Callable[..., Path],
    aside: Sequence[str] = (),
) -> int:
    """Conceals the cases that the command line names, has each diagnosed, and says whether all were found.

    `make` writes a study into a folder, of a law and a seed. Effects that are set `aside` may be said of any.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("cases", nargs="*", default=usual, help=", ".join(cases))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only-write", type=Path, help="make the studies in this folder and stop")
    options = parser.parse_args()
    if unknown := [name for name in options.cases if name not in cases]:
        parser.error(f"no such case: {', '.join(unknown)}; allowed: {', '.join(cases)}")
    missed = 0
    for name in options.cases:
        law, effect, element = cases[name]
        if options.only_write:
            make(options.only_write / name, law, options.seed)
            continue
        with tempfile.TemporaryDirectory() as folder:
            line = diagnosed(make(Path(folder) / "study", law, options.seed))
        effects = [e for e in line.get("effects", []) if e["name"] not in aside]
        said = [(e["name"], e["element"]["name"]) for e in effects]
        line |= {"case": name, "seed": options.seed, "found": said == ([(effect, element)] if effect else [])}
        missed += not line["found"]
        append(log, line)
        print(f"{name}: {line.get('summary', line['verdict'])} ({line['seconds']:.0f} s)", flush=True)
    return int(missed > 0)
