"""A believed arm, and the command line that imports recordings of it."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from det2stoc_bayes import cli

ARM = """<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="wrist" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 -0.3" size="0.03" mass="0.7" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="wrist"/></actuator>
  <sensor><jointpos name="encoder" joint="wrist"/></sensor>
</mujoco>
"""
TIME = 0.01 * np.arange(40)
ANGLE, SPEED, TORQUE = 0.3 * np.sin(5 * TIME), 1.5 * np.cos(5 * TIME), 0.1 * np.cos(9 * TIME)


@dataclass(frozen=True)
class Workplace:
    """A folder with arm.xml; `run` gives exit code and the lines on stderr, `out` is where a study goes."""

    folder: Path
    out: Path
    run: Callable[..., tuple[int, list[str]]]

    def imported(self, form: str, source: Path | str, *more: str) -> tuple[int, list[str]]:
        model = () if "--model" in more or form == "urdf" else ("--model", str(self.folder / "arm.xml"))
        return self.run("import", form, str(self.folder / source), "--out", str(self.out), *model, *more)

    def recording(self, name: str) -> tuple[list[str], np.ndarray]:
        """Header and rows of what was written."""
        header, *rows = (self.out / "recordings" / f"{name}.csv").read_text().splitlines()
        return header.split(","), np.array([[float(c) if c else np.nan for c in row.split(",")] for row in rows])


def run(*arguments: str) -> tuple[int, list[str]]:
    result = CliRunner().invoke(cli.app, list(arguments), catch_exceptions=False)
    return result.exit_code, [line for line in result.stderr.splitlines() if line.strip()]


@pytest.fixture
def place(tmp_path: Path) -> Workplace:
    (tmp_path / "arm.xml").write_text(ARM)
    return Workplace(tmp_path, tmp_path / "study", run)


sys.modules["importing_arm"] = sys.modules[__name__]  # tests of this folder take the arm's motion from here
