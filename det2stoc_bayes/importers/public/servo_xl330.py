"""A Dynamixel XL330 servo that swings a mass, recorded by Rhoban's bam (Duclusaud et al., arXiv:2410.08650)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from det2stoc_bayes.importers.bam import column, load, signed
from det2stoc_bayes.importers.base import SourceError, clock
from det2stoc_bayes.importers.public.base import Converted, Dataset
from det2stoc_bayes.importers.write import Table

_STARTS = ("28m10", "28m17", "28m24", "28m32", "28m42", "28m49", "28m57", "29m04")
_STARTS += ("29m14", "29m21", "29m29", "29m37", "29m47", "29m54", "30m02", "30m10")
FILES = tuple(f"bam/data.bak/raw/2026-01-15_10h{start}.json" for start in _STARTS)
GRID = 0.005  # s
LATER = 0.0024  # s: a row's position is so much older than its PWM, since registers are read one after the other
SUPPLY_LATER = 0.0007  # s: the supply's voltage is so much younger than the PWM
FULL_DUTY = 885  # counts
SWITCHED_OFF = 2.0  # s: then lift_and_drop disconnects the motor
HELD_OUT_GAIN = 400
MODEL = """<mujoco model="servo_xl330">
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 -9.80665"/>
  <worldbody>
    <body name="pendulum" pos="0 0 0.5">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.005" armature="0.002"/>
      <inertial pos="0 0 -0.1" mass="0.49" diaginertia="1e-6 1e-6 1e-6"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.005" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <general name="motor" joint="hinge" gainprm="0.104" biastype="affine" biasprm="0 0 -0.037"/>
  </actuator>
</mujoco>
"""
STUDY = """model = "model.xml"
recordings = "recordings/*.csv"
holdout = "holdout/*.csv"

[psi.motor_gain]
target = "actuator/motor/gainprm"
index = [0]
prior = { TruncatedNormal = { loc = 0.104, scale = 0.03, low = 0.02 } }

[psi.back_emf]
target = "actuator/motor/biasprm"
index = [2]
prior = { TruncatedNormal = { loc = -0.037, scale = 0.012, high = 0.0 } }

[psi.armature]
target = "joint/hinge/armature"
prior = { TruncatedNormal = { loc = 0.002, scale = 0.001, low = 0.0001 } }

[psi.damping]
target = "joint/hinge/damping"
prior = { TruncatedNormal = { loc = 0.005, scale = 0.005, low = 0.0 } }

[psi.zero]
target = "opt/gravity"
index = [0]
prior = { Normal = { loc = 0.0, scale = 0.3 } }

[noise]
"qpos/*" = 0.0006
"""
SOURCE = """A Dynamixel XL330 servo (position mode, firmware P gain 100, 200, 400 or 800) swings 0.49 kg at 0.10 m
(M. Duclusaud, G. Passault et al., arXiv:2410.08650; 16 runs of the repository's git history).

- Registers about every 5.3 ms, one after the other: position (4096 counts a turn), PWM (of 885), supply (0.1 V).
- Runs with gain 400 -> `holdout`, the others -> `recordings`.
- Converted: position in rad, 0 hangs down, interpolated to a grid of 5 ms, which begins 5 ms after the first voltage;
  `ctrl/motor` = PWM duty times supply voltage [V], with the value at the middle of the interval over which it is held.
  The PWM register is signed and was stored unsigned. Position is 2.4 ms older and supply 0.7 ms younger than PWM; both
  were moved by that.
  `lift_and_drop`: the first 2 s alone, while the motor is switched on. The smoothed speed register is left out.
- Prior means from the XL330-M288-T data sheet. `psi.zero` stands for the position sensor's unknown zero; `back_emf` and
  `damping` act alike. Noise 6e-4 rad (half a count)."""


def convert(files: Mapping[str, Path]) -> Converted:
    """A run a file, called by its gain and trajectory."""
    fitted: dict[str, Table] = {}
    held: dict[str, Table] = {}
    for path in files.values():
        head, entries = load(path)
        missing = [key for key in ("kp", "trajectory") if key not in head]
        if missing:
            raise SourceError(f"{path.name}: no '{missing[0]}'; allowed: a log of bam")
        name = f"kp{head['kp']}_{head['trajectory']}"
        if name in fitted or name in held:
            raise SourceError(f"{path.name}: a second run called {name}; allowed: one")
        (held if head["kp"] == HELD_OUT_GAIN else fitted)[name] = _run(entries, str(head["trajectory"]), path.name)
    return Converted(fitted, held, STUDY)


def _run(entries: list[dict], trajectory: str, where: str) -> Table:
    stamps = clock(column(entries, "timestamp", where), f"{where}: timestamp")
    kept = stamps <= SWITCHED_OFF if trajectory == "lift_and_drop" else np.ones(len(stamps), bool)
    stamps = stamps[kept]
    position = column(entries, "position", where)[kept]
    supply = np.interp(stamps, stamps + SUPPLY_LATER, column(entries, "input_volts", where)[kept])
    volts = signed(column(entries, "load", where)[kept]) / FULL_DUTY * supply
    if len(stamps) < 3 or stamps[-1] - stamps[0] < 4 * GRID:
        raise SourceError(f"{where}: found {len(stamps)} rows; allowed: a run longer than {4 * GRID} s")
    first = stamps[0] + GRID  # of the voltage's clock
    ahead = max(LATER, GRID / 2)
    time = GRID * np.arange(int(np.floor((stamps[-1] - ahead - first) / GRID)) + 1)
    at = first + time
    rows = [time, np.interp(at + LATER, stamps, position), np.interp(at + GRID / 2, stamps, volts)]
    return Table(("time", "qpos/hinge", "ctrl/motor"), np.column_stack(rows))


DATASET = Dataset(
    name="servo_xl330",
    repository="Rhoban/bam",
    commit="af2260462471ff45ac18af159b1327ea51d8db15",
    files=FILES,
    license="Apache License 2.0, Copyright 2025 Marc Duclusaud & Gregoire Passault",
    model=MODEL,
    source=SOURCE,
    convert=convert,
)
