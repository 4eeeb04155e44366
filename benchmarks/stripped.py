"""Real studies whose model has lost a piece that is documented: the diagnosis must name it.

Each study is copied without the piece (and without the psi that would stand in for it), diagnosed by a process of its
own, and a table is printed as Markdown; results go to benchmarks/results/stripped.jsonl.
"""

import argparse
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
from logs import append
from real import diagnosed

LOG = Path(__file__).parent / "results" / "stripped.jsonl"


@dataclass(frozen=True)
class Piece:
    """What is taken out of a study's model, the psi that go with it, and the effect that it then lacks."""

    study: str
    says: str
    psi: tuple[str, ...]
    remove: Callable[[Any], None]  # from a mujoco.MjSpec
    effect: str
    element: str


def _no_damping(spec: Any) -> None:
    spec.joint("hinge").damping = [0.0] * 3  # of a polynomial in speed


def _no_back_emf(spec: Any) -> None:
    _no_damping(spec)
    spec.actuator("motor").biasprm = [0.0] * len(spec.actuator("motor").biasprm)


def _no_rotor(spec: Any) -> None:
    spec.joint("hinge").armature = 0.0


def _no_gravity(spec: Any) -> None:
    spec.option.gravity = [0.0, 0.0, 0.0]


PIECES = (
    Piece("pendulum_multiarm", "damping of the hinge", ("damping",), _no_damping, "viscous_damping", "hinge"),
    # Back-EMF and viscous damping act alike: with either left in, nothing is missing.
    Piece("servo_xl330", "back-EMF and damping", ("back_emf", "damping"), _no_back_emf, "viscous_damping", "hinge"),
    Piece("servo_xl330", "the rotor's inertia", ("armature",), _no_rotor, "armature", "hinge"),
    Piece("ball_drops", "gravity", ("gravity",), _no_gravity, "gravity_error", ""),
)


def strip(study: Path, piece: Piece, folder: Path) -> Path:
    """A copy of a study without the piece."""
    shutil.copytree(study, folder)
    text = (folder / "study.toml").read_text("utf-8")
    for name in piece.psi:
        text, count = re.subn(rf"^\[psi\.{re.escape(name)}\]\n(?:[^\[\n].*\n|\n)*", "", text, flags=re.M)
        if count != 1:
            raise ValueError(f"{study / 'study.toml'}: psi.{name} occurs {count} times; allowed: once")
    (folder / "study.toml").write_text(text, "utf-8")
    spec = mujoco.MjSpec.from_file(str(folder / "model.xml"))
    piece.remove(spec)
    spec.compile()
    (folder / "model.xml").write_text(spec.to_xml(), "utf-8")
    return folder


def found(line: Mapping[str, Any], piece: Piece) -> bool:
    """Whether the piece, or an equivalent of it, is named on its element."""
    if line.get("verdict") != "mismatch":
        return False
    given = [entry for e in line["effects"] for entry in (e, *e["equivalent"])]
    return any(g["name"] == piece.effect and piece.element in ("", g["element"]["name"]) for g in given)


def main() -> int:
    """Diagnose studies of a folder without a documented piece."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("names", nargs="*", help="studies to run; all if none is named")
    parser.add_argument("--studies", type=Path, required=True, help="folder of studies")
    options = parser.parse_args()
    known = list(dict.fromkeys(piece.study for piece in PIECES))
    chosen, missed = options.names or known, 0
    absent = [n for n in chosen if n not in known or not (options.studies / n / "study.toml").is_file()]
    if absent:
        print(f"{options.studies}: no such study: {', '.join(absent)}; allowed: {', '.join(known)}", file=sys.stderr)
        return 2
    print("| study | taken out | found | what is said | seconds |\n|---|---|---|---|---|")
    for piece in (p for p in PIECES if p.study in chosen):
        with tempfile.TemporaryDirectory() as folder:
            line = diagnosed(strip(options.studies / piece.study, piece, Path(folder) / "study"))
        line |= {"study": piece.study, "piece": piece.says, "found": found(line, piece)}
        missed += not line["found"]
        append(LOG, line)
        yes = "yes" if line["found"] else "no"
        said = line.get("summary", line["verdict"])
        print(f"| {piece.study} | {piece.says} | {yes} | {said} | {line['seconds']:.0f} |", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
