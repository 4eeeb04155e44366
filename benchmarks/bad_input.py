"""Bad input of many kinds: what `det2stoc check` says of each, as docs/bad_input.md.

    python benchmarks/bad_input.py > docs/bad_input.md

Every case spoils one thing in a study that is fine. An error is one line and exit code 2; a warning is one line, and
the check goes on.
"""

import math
import os
import pickle
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from typer.testing import CliRunner

from det2stoc_bayes import cli

MODEL = """<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="elbow" axis="0 1 0" damping="0.05" range="-170 170" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 -0.3" size="0.03" mass="0.7" contype="0" conaffinity="0"/>
    </body>
    <body name="stone" pos="0 0 9"><freejoint name="float"/>
      <geom type="box" size="0.1 0.06 0.03" mass="0.8" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator><motor name="drive" joint="elbow"/></actuator>
</mujoco>
"""
STUDY = """model = "model.xml"
recordings = "recordings/*.csv"

[psi.damping]
target = "joint/elbow/damping"
prior = { LogNormal = { loc = -3.0, scale = 0.5 } }

[noise]
"qpos/elbow" = 1e-3
"""
COLUMNS = ("qpos/elbow", *(f"qpos/float/{p}" for p in ("qw", "qx", "qy", "qz")), "ctrl/drive")


def make_study(folder: Path) -> None:
    """A swing of an arm and a tumbling stone, 60 samples."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[0], data.qvel[4:] = 0.5, (1.0, 3.0, -2.0)
    lines = [",".join(("time", *COLUMNS))]
    for i in range(60):
        data.ctrl[0] = math.sin(0.3 * i)
        values = (data.qpos[0] + 1e-3 * random.standard_normal(), *data.qpos[4:8], data.ctrl[0])
        lines.append(",".join(repr(float(v)) for v in (0.02 * i, *values)))
        mujoco.mj_step(model, data, 10)
    (folder / "recordings").mkdir(parents=True)
    (folder / "model.xml").write_text(MODEL)
    (folder / "study.toml").write_text(STUDY)
    (folder / "recordings/swing.csv").write_text("\n".join(lines) + "\n")


@dataclass(frozen=True)
class Case:
    """One thing that is wrong; `error` where it must be refused, else a warning must say it."""

    kind: str
    spoil: Callable[[Path], object]
    error: bool = True


def replaced(name: str, old: str, new: str) -> Callable[[Path], object]:
    """Another text in a file of the study; the first occurrence."""

    def spoil(folder: Path) -> None:
        text = (folder / name).read_text()
        if old not in text:
            raise ValueError(f"{name} has no '{old}'")
        (folder / name).write_text(text.replace(old, new, 1))

    return spoil


def cells(change: Callable[[list[list[str]]], object]) -> Callable[[Path], object]:
    """Other cells, header first, in the recording."""

    def spoil(folder: Path) -> None:
        path = folder / "recordings/swing.csv"
        rows = [line.split(",") for line in path.read_text().splitlines()]
        change(rows)
        path.write_text("\n".join(",".join(row) for row in rows) + "\n")

    return spoil


def column(name: str, value: Callable[[float], object]) -> Callable[[Path], object]:
    """Another value in every cell of a column."""

    def change(rows: list[list[str]]) -> None:
        j = rows[0].index(name)
        for row in rows[1:]:
            row[j] = str(value(float(row[j])))

    return cells(change)


def without(*columns: str) -> Callable[[Path], object]:
    """Columns left out."""

    def change(rows: list[list[str]]) -> None:
        keep = [j for j, name in enumerate(rows[0]) if name not in columns]
        rows[:] = [[row[j] for j in keep] for row in rows]

    return cells(change)


def cell(row: int, name: str, text: str) -> Callable[[Path], object]:
    """Another text in one cell, `row` below the header."""
    return cells(lambda rows: rows[row].__setitem__(rows[0].index(name), text))


def added(text: str) -> Callable[[Path], object]:
    """More lines in study.toml."""
    return lambda folder: (folder / "study.toml").write_text(STUDY + text)


def recording(content: bytes) -> Callable[[Path], object]:
    """Another content of the recording."""
    return lambda folder: (folder / "recordings/swing.csv").write_bytes(content)


def _huge(folder: Path) -> None:
    os.truncate(folder / "recordings/swing.csv", 5_000_000_000)  # no disk is used


def _pickled(folder: Path) -> None:
    (folder / "recordings/swing.pkl").write_bytes(pickle.dumps({"time": [0.0, 1.0]}))
    replaced("study.toml", "*.csv", "*.pkl")(folder)


def _stuck(rows: list[list[str]]) -> None:
    rows[30][1] = str(float(rows[30][1]) + 1.0)


TRUTH = "prior = { LogNormal = { loc = -3.0, scale = 0.5 } }"
HEADER = ",".join(("time", *COLUMNS))
CASES = (
    Case("no study.toml", lambda folder: (folder / "study.toml").unlink()),
    Case("TOML syntax", replaced("study.toml", "[noise]", "[noise")),
    Case("unknown key", replaced("study.toml", "recordings =", "recording =")),
    Case("unknown key of a psi", replaced("study.toml", "prior =", "priors =")),
    Case("missing model", replaced("study.toml", "model.xml", "modle.xml")),
    Case("MJCF that does not compile", replaced("model.xml", 'type="capsule"', 'type="capsul"')),
    Case("MJCF that is no XML", replaced("model.xml", "</worldbody>", "")),
    Case("path outside of the folder", replaced("study.toml", '"model.xml"', '"../model.xml"')),
    Case("recordings outside of the folder", replaced("study.toml", "recordings/*", "../recordings/*")),
    Case("no recordings", replaced("study.toml", "recordings/*", "records/*")),
    Case("misspelt joint in a psi", replaced("study.toml", "joint/elbow", "joint/elbwo")),
    Case("unknown body in a psi", replaced("study.toml", "joint/elbow/damping", "body/hand/mass")),
    Case("unknown field", replaced("study.toml", "elbow/damping", "elbow/dampng")),
    Case("the timestep as psi", replaced("study.toml", "joint/elbow/damping", "opt/timestep")),
    Case("index out of range", replaced("study.toml", 'joint/elbow/damping"', 'body/arm/ipos"\nindex = [3]')),
    Case("index missing", replaced("study.toml", "joint/elbow/damping", "body/arm/ipos")),
    Case("unknown distribution", replaced("study.toml", "LogNormal", "LogNormel")),
    Case("wrong argument of a distribution", replaced("study.toml", "scale", "scael")),
    Case("argument out of range", replaced("study.toml", "scale = 0.5", "scale = -0.5")),
    Case("prior below 0 of a damping", replaced("study.toml", TRUTH, "prior = { Uniform = { low = -2, high = -1 } }")),
    Case(
        "prior partly below 0",
        replaced("study.toml", TRUTH, "prior = { Normal = { loc = 0.05, scale = 0.05 } }"),
        False,
    ),
    Case("negative noise", replaced("study.toml", "1e-3", "-1e-3")),
    Case("noise of an unknown column", replaced("study.toml", '"qpos/elbow" =', '"qpos/elbwo" =')),
    Case("known of a recording that is not there", added('[known.swung]\n"body/arm/mass" = 0.7\n')),
    Case("known vector of the wrong length", added('[known.swing]\n"body/arm/ipos" = [0.1, 0.2]\n')),
    Case("unknown likelihood", added('[likelihood]\nnoise = "cauchy"\n')),
    Case("misspelt joint in a recording", replaced("recordings/swing.csv", "qpos/elbow", "qpos/elbwo")),
    Case("duplicate column", replaced("recordings/swing.csv", "ctrl/drive", "qpos/elbow")),
    Case("no time", replaced("recordings/swing.csv", "time", "t")),
    Case(
        "semicolons for commas", lambda f: recording((f / "recordings/swing.csv").read_bytes().replace(b",", b";"))(f)
    ),
    Case("empty file", recording(b"")),
    Case("header only", recording(HEADER.encode() + b"\n")),
    Case("one sample", cells(lambda rows: rows.__delitem__(slice(2, None)))),
    Case("truncated file", lambda f: recording((f / "recordings/swing.csv").read_bytes()[:-40])(f)),
    Case("time goes back", cell(9, "time", "0.01")),
    Case("time missing", cell(9, "time", "")),
    Case("text in a cell", cell(9, "qpos/elbow", "lost")),
    Case("NaN", cell(9, "qpos/elbow", "nan")),
    Case("infinity", cell(9, "qpos/elbow", "-inf")),
    Case("no unit quaternion", cell(9, "qpos/float/qw", "0.2")),
    Case("part of a quaternion", without("qpos/float/qx")),
    Case("nothing measured", without(*COLUMNS[:5])),
    Case("column without a value", column("qpos/elbow", lambda _: "")),
    Case("binary file as csv", recording(bytes(range(256)))),
    Case("pickle as csv", recording(pickle.dumps({"time": [0.0]}))),
    Case("pickle", _pickled),
    Case("huge file", _huge),
    Case("degrees for radians", column("qpos/elbow", math.degrees), False),
    Case("constant channel", column("qpos/elbow", lambda _: 0.25), False),
    Case("no column of an actuator", without("ctrl/drive"), False),
    Case("the model cannot follow", column("qpos/elbow", lambda v: 1.2 - 3.0 * v), False),
    Case("one glitch", cells(_stuck), False),
    Case("a model that diverges", replaced("model.xml", 'damping="0.05"', 'stiffness="-1e9"')),
)


def outcome(case: Case, folder: Path, command: str = "check") -> tuple[int, list[str]]:
    """Exit code and the lines of errors and warnings; nothing else may have been said or written."""
    study = folder / "study"
    make_study(study)
    case.spoil(study)
    before = sorted(study.rglob("*"))
    arguments = ["check", str(study)] if command == "check" else [command, str(study), "--out", str(folder / "out")]
    shown = CliRunner().invoke(cli.app, arguments)
    said = [line for line in shown.stderr.splitlines() if re.match(r"error|warning|unforeseen", line)]
    if sorted(study.rglob("*")) != before or (folder / "out").exists():
        raise RuntimeError(f"{case.kind}: something was written")
    if "Traceback" in shown.stdout + shown.stderr:
        raise RuntimeError(f"{case.kind}: a traceback was shown")
    return shown.exit_code, said


def row(case: Case, code: int, said: list[str], folder: Path) -> str:
    """A case in the table."""
    text = "<br>".join(said).replace(f"{folder}/", "").replace("|", "\\|")
    return f"| {case.kind} | {'E' if code == 2 else 'W' if code == 0 else code} | {text} |"


def table() -> str:
    """Markdown: a row a case."""
    rows = [
        "# What bad input is told",
        "",
        "Made by `python benchmarks/bad_input.py`; E: refused with exit code 2.",
        "",
    ]
    rows += ["| what is wrong | | what `det2stoc check` says |", "|---|---|---|"]
    for case in CASES:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(row(case, *outcome(case, Path(folder)), Path(folder)))
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    print(table(), end="")
