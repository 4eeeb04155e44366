"""Balls that were dropped from a bridge and filmed (de Silva et al., Frontiers in Artificial Intelligence, 2020)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from det2stoc_bayes.importers.base import SourceError, numbers
from det2stoc_bayes.importers.public.base import Converted, Dataset
from det2stoc_bayes.importers.write import Table

SHEETS, BALLS = "data/Ball_drops_data.xls", "data/balls.txt"  # the former is an .xlsx in fact
# Sheet -> the ball's name in balls.txt. The volleyball's mass and size are not known.
NAMES = {
    "Baseball": "baseball", "Blue Basketball": "bluebasketball", "Bowling Ball": "bowlingball",
    "Golf Ball": "golfball", "Green Basketball": "greenbasketball", "Orange Whiffle Ball": "orangeWiffle",
    "Tennis Ball": "tennisball", "Whiffle Ball 1": "wiffleball1", "Whiffle Ball 2": "wiffleball2",
    "Yellow Whiffle Ball": "yellowWiffle",
}  # fmt: skip
DROP, TIME, HEIGHT = "Drop #", "Time (s)", "Height (m)"
OUNCE = 0.028349523125  # kg
FALLEN, FIRST = 0.5, 10  # m below the highest of so many samples: the hand has let go
MODEL = """<mujoco model="ball_drops">
  <option timestep="0.002" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="ball" pos="0 0 0">
      <joint name="height" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.036" mass="0.14" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
STUDY = """model = "model.xml"
recordings = "recordings/*.csv"
holdout = "holdout/*.csv"

[psi.gravity]
target = "opt/gravity"
index = [2]
prior = { Normal = { loc = -9.81, scale = 0.02 } }

[noise]
"qpos/height" = 0.06
"""
SOURCE = """Sports balls dropped from a bridge and filmed with a hand-held camera (B. de Silva et al., "Discovery of
Physics From Data: Universal Laws and Discrepancies", Frontiers in Artificial Intelligence 3:25, 2020).

- Height [m] at 15 frames a second, tracked in the video. The source's velocity was differentiated, and is left out.
- First drop of each ball -> `recordings`, second -> `holdout`; no volleyball, whose mass and size are not known.
- Converted: a recording starts at the first sample 0.5 m below the highest of the first ten (by then the hand has let
  go); its last sample is dropped (in several drops the ball had reached the ground). Times begin at 0.
- Noise 0.06 m. Masses (ounces) and circumferences (cm) of balls.txt stand in study.toml as kg and radius in m; the
  sheet "Bowling Ball" is taken to be the bowling ball of 81 oz. Heights refer to an arbitrary level."""


def convert(files: Mapping[str, Path]) -> Converted:
    """Two drops of each ball's sheet, and what is known of the ball."""
    sheets, balls = _sheets(files[SHEETS]), _balls(files[BALLS])
    fitted, held, known = {}, {}, []
    for sheet, ball in NAMES.items():
        for drop, where in ((1, fitted), (2, held)):
            stem = f"{sheet.lower().replace(' ', '_')}_drop{drop}"
            where[stem] = _drop(sheets[sheet], drop, f"{Path(SHEETS).name}: {sheet}, drop {drop}")
            mass, radius = balls[ball]
            known.append(
                f'\n[known.{stem}]\n"body/ball/mass" = {mass:.6f}\n"geom/ball/size" = [{radius:.6f}, 0.0, 0.0]\n'
            )
    return Converted(fitted, held, STUDY + "".join(sorted(known)))


def _drop(columns: Mapping[str, np.ndarray], drop: int, where: str) -> Table:
    rows = columns[DROP] == drop
    time, height = columns[TIME][rows], columns[HEIGHT][rows]
    fallen = np.flatnonzero(height <= height[:FIRST].max(initial=-np.inf) - FALLEN)
    if not len(fallen) or len(time) - fallen[0] < 3:
        raise SourceError(f"{where}: found no fall in {len(time)} samples; allowed: the file of the pinned commit")
    kept = slice(int(fallen[0]), -1)
    return Table(("time", "qpos/height"), np.column_stack([time[kept] - time[kept][0], height[kept]]))


def _sheets(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """The columns of every sheet by their headings."""
    try:
        import openpyxl
    except ImportError as error:
        raise SourceError(
            "ball_drops: needs the package openpyxl; allowed: pip install 'det2stoc-bayes[import]'"
        ) from error
    try:
        with path.open("rb") as file:  # by its content: the suffix is another's
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            content = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in book.worksheets}
    except Exception as error:  # BadZipFile, and errors of several XML parsers
        raise SourceError(
            f"{path.name}: cannot be read: {type(error).__name__}: {error}; allowed: an Excel workbook"
        ) from error
    missing = [name for name in NAMES if name not in content]
    if missing:
        raise SourceError(f"{path.name}: no sheet '{missing[0]}'; allowed: the file of the pinned commit")
    return {name: _columns(content[name], f"{path.name}: {name}") for name in NAMES}


def _columns(rows: list[tuple], where: str) -> dict[str, np.ndarray]:
    header = [str(cell).strip() for cell in rows[0]] if rows else []
    for name in (DROP, TIME, HEIGHT):
        if name not in header:
            raise SourceError(
                f"{where}: no column '{name}'; found {', '.join(header)}; allowed: {DROP}, {TIME}, {HEIGHT}"
            )
    places = [header.index(name) for name in (DROP, TIME, HEIGHT)]
    cells = [[row[p] for p in places] for row in rows[1:] if len(row) > max(places)]
    full = [row for row in cells if all(cell is not None for cell in row)]
    values = numbers(full, where).reshape(-1, 3)
    return dict(zip((DROP, TIME, HEIGHT), values.T, strict=True))


def _balls(path: Path) -> dict[str, tuple[float, float]]:
    """Ball -> mass [kg] and radius [m]."""
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines()[1:]:
        name, *cells = line.split()
        if len(cells) == 2 and "??" not in cells:
            ounces, centimetres = numbers(cells, f"{path.name}: {name}").tolist()
            found[name] = (ounces * OUNCE, centimetres / 100 / (2 * np.pi))
    missing = [name for name in NAMES.values() if name not in found]
    if missing:
        raise SourceError(f"{path.name}: no ball '{missing[0]}'; allowed: the file of the pinned commit")
    return found


DATASET = Dataset(
    name="ball_drops",
    repository="briandesilva/discovery-of-physics-from-data",
    commit="b79c34317f049c9b47aaf2cc4c54c5ec7219f3d7",
    files=(SHEETS, BALLS),
    license="MIT, Copyright (c) 2020 Brian de Silva",
    model=MODEL,
    source=SOURCE,
    convert=convert,
)
