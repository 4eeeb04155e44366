"""Windy Slope: a box on a slope in the wind, learned from few episodes by det2stoc and by a CVAE of its own."""

from pathlib import Path
from typing import Any

from det2stoc_bayes.report.scene_page import scene_page as page
from det2stoc_bayes.reproduce.experiment import run_scene
from det2stoc_bayes.reproduce.parts import Progress
from det2stoc_bayes.reproduce.windy_slope_alarm import alarms
from det2stoc_bayes.reproduce.windy_slope_scene import SCENE
from det2stoc_bayes.reproduce.work import Settings

FULL = Settings()
QUICK = Settings(1, 2, 300, 150, 1500, 1500, 1500, 10, 200, 20, 0, variants=False)  # in less than three minutes
__all__ = ["page", "run"]


def run(
    out: Path, *, seed: int = 0, quick: bool = False, jobs: int = 0, progress: Progress = lambda *_: None
) -> dict[str, Any]:
    """Results, as results.json holds them; what is done is kept in `out`."""
    return run_scene("windy-slope", SCENE, QUICK if quick else FULL, out, seed, progress, jobs, alarms)
