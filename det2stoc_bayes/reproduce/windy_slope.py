"""Windy Slope: a box on a slope in the wind, learned from few episodes by det2stoc and by a CVAE of its own."""

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models import windy_slope
from det2stoc_bayes.report.windy_slope_page import windy_slope_page as page
from det2stoc_bayes.reproduce.parts import Progress
from det2stoc_bayes.reproduce.windy_slope_alarm import alarms
from det2stoc_bayes.reproduce.windy_slope_figures import figures
from det2stoc_bayes.reproduce.windy_slope_models import Seed
from det2stoc_bayes.reproduce.windy_slope_scores import NEIGHBOURS, population_oracle, rollout_scores, state_oracle
from det2stoc_bayes.reproduce.windy_slope_work import Settings, Work
from det2stoc_bayes.transitions import Transitions

SOURCE = {
    "baseline 1000": (69.42, 1.73), "baseline 10000": (80.35, 0.60), "det2stoc 1": (66.93, 0.54),
    "det2stoc 2": (78.65, 0.53), "det2stoc 3": (81.74, 0.61),
}  # fmt: skip
PRIMARY = "matched"
ORACLES = {"population": "its population", "state": "p(psi | state)"}
__all__ = ["page", "run"]


def run(out: Path, *, seed: int = 0, quick: bool = False, progress: Progress = lambda *_: None) -> dict[str, Any]:
    """Every model of every seed; each is kept in `out` as soon as it is done, and not done again."""
    work = Work(out, Settings.quick() if quick else Settings(), seed, progress)
    settings = work.settings
    tested_psi = windy_slope.REALITY.draw(work.random(0), settings.num_test)
    tested = work.simulate(tested_psi, "simulating the test set")
    test = Transitions.of_episodes(tested)
    seeds = []
    for number in range(settings.num_seeds):
        models = Seed(work, number, *work.recorded(number), tested).models()
        seeds.append({"seed": number, "models": models})
    found = rows(seeds)
    oracles = work.kept("oracles", lambda: _oracles(work, tested, test))
    simulators = {r["name"]: StochasticSimulator.load(work.saved(0, r["name"])) for r in found}
    return {
        "experiment": "windy-slope",
        "seed": seed,
        "settings": asdict(settings),
        "oracles": oracles,
        "alarms": work.kept("alarms", lambda: {"priors": alarms(work)})["priors"],
        "table": _table(found, oracles, settings),
        "rows": found,
        "seeds": seeds,
        "scene": {"names": windy_slope.NAMES, "units": windy_slope.UNITS, "state": windy_slope.STATE},
        "truth": {"mean": windy_slope.REALITY.loc, "sd": windy_slope.REALITY.scale},
        "figures": work.kept("figures", lambda: figures(tested, tested_psi, simulators, work.random(5))),
    }


def rows(seeds: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean and sd over the seeds that have it of every model's metrics, beside the source's log likelihood."""
    out = []
    for name in seeds[0]["models"]:
        of_model = [s["models"][name] for s in seeds if name in s["models"]]
        values = {m: np.array([o["metrics"][m] for o in of_model]) for m in of_model[0]["metrics"]}
        spread = {m: [float(v.mean()), float(v.std(ddof=1)) if len(v) > 1 else None] for m, v in values.items()}
        about = {"name": name, "source": SOURCE.get(name)} | {k: of_model[0][k] for k in ("real", "variant")}
        out.append(about | {"metrics": spread})
    return out


def _table(found: list[dict[str, Any]], oracles: Mapping[str, Any], settings: Settings) -> dict[str, Any]:
    told = [
        [r["name"], str(r["real"]), *r["metrics"][PRIMARY], *r["metrics"]["mixture"], *(r["source"] or ["", ""])]
        for r in found
    ]
    told += [[f"oracle: psi from {name}", "", oracles[key], *[""] * 5] for key, name in ORACLES.items()]
    return {
        "title": f"windy-slope, seeds: {settings.num_seeds}; log likelihood of the test set [nat a transition]",
        "columns": ["model", "real samples>", "matched Gaussian>", "sd>", "mixture>", "sd>", "source>", "sd>"],
        "rows": told,
    }


def _oracles(work: Work, tested: np.ndarray, test: Transitions) -> dict[str, Any]:
    """What the simulator itself would score."""
    settings, stage = work.settings, partial(work.progress, "asking the oracle")
    psi = windy_slope.REALITY.draw(work.random(4), max(settings.num_simulated, settings.num_oracle))
    states = work.simulate(psi, "simulating for the oracle")
    ask, count = windy_slope.simulate, settings.num_oracle
    enough = len(psi) >= 2 * NEIGHBOURS  # a regression on fewer would be surer than it may be
    return {
        "population": population_oracle(test, psi[:count], ask, stage),
        "state": state_oracle(test, psi, states, count, work.random(6), ask, stage) if enough else None,
        **rollout_scores(states[: settings.num_draws], tested),
    }
