"""YuMi Pusher: a robot pushes a box, learned from few episodes by det2stoc and by a CVAE of its own."""

from pathlib import Path
from typing import Any

from det2stoc_bayes.report.scene_page import scene_page as page
from det2stoc_bayes.reproduce.experiment import run_scene
from det2stoc_bayes.reproduce.parts import Progress
from det2stoc_bayes.reproduce.work import Settings
from det2stoc_bayes.reproduce.yumi_pusher_exact import exact_posteriors
from det2stoc_bayes.reproduce.yumi_pusher_scene import SCENE

FULL = Settings(
    num_seeds=3, num_iterations=3, num_first=2_000, num_simulated=2_000, first_steps=12_000, decoder_steps=6_000,
    num_test=30, num_draws=500, num_oracle=200, num_alarm=0, variants=False, baselines=(10, 1000), episode_steps=2_400,
    num_particles=24, num_marginal=1_000,
)  # fmt: skip
QUICK = Settings(
    1, 2, 200, 100, 1000, 1000, 1000, 6, 100, 20, 0, variants=False, baselines=(10, 50), episode_steps=600,
    num_particles=16,
)  # fmt: skip
__all__ = ["page", "run"]


def run(
    out: Path, *, seed: int = 0, quick: bool = False, jobs: int = 0, progress: Progress = lambda *_: None
) -> dict[str, Any]:
    """Results, as results.json holds them; what is done is kept in `out`."""
    settings = QUICK if quick else FULL
    return run_scene("yumi-pusher", SCENE, settings, out, seed, progress, jobs, exact=exact_posteriors)
