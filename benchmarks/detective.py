"""Cases that conceal something in a scene of the project's, each diagnosed by a process that sees its study alone."""

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import mujoco
from logs import append
from real import diagnosed

FREE_Q, FREE_V = ("x", "y", "z", "qw", "qx", "qy", "qz"), ("vx", "vy", "vz", "wx", "wy", "wz")
FILES = """model = "model.xml"
recordings = "recordings/*.csv"
holdout = "holdout/*.csv"
"""
Law = Callable[[mujoco.MjModel], Callable[[mujoco.MjData], None]]  # prepares a model; what to do before each step
Case = tuple[Law | None, str, str]  # what is concealed, its name and element


def conceal(
    about: str | None, cases: Mapping[str, Case], usual: Sequence[str], log: Path, write: Callable[..., Path]
) -> int:
    """Conceals the cases that the command line names, has each diagnosed, and says whether all were found.

    `write` makes a study's files in a folder, of a law and a seed.
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
            write(options.only_write / name, law, options.seed)
            continue
        with tempfile.TemporaryDirectory() as folder:
            line = diagnosed(write(Path(folder) / "study", law, options.seed))
        said = [(e["name"], e["element"]["name"]) for e in line.get("effects", [])]
        line |= {"case": name, "seed": options.seed, "found": said == ([(effect, element)] if effect else [])}
        missed += not line["found"]
        append(log, line)
        print(f"{name}: {line.get('summary', line['verdict'])} ({line['seconds']:.0f} s)", flush=True)
    return int(missed > 0)
