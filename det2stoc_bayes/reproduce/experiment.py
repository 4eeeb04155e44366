"""An experiment on a scene: it is learned from few episodes by det2stoc and by a CVAE of its own, and scored."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models._runs import Runs
from det2stoc_bayes.reproduce.parts import Progress
from det2stoc_bayes.reproduce.populations import populations_table
from det2stoc_bayes.reproduce.scene import Scene
from det2stoc_bayes.reproduce.scene_figures import figures
from det2stoc_bayes.reproduce.scores import NEIGHBOURS, known_oracle, population_oracle, rollout_scores, state_oracle
from det2stoc_bayes.reproduce.seed_models import Seed, first_simulations, num_models
from det2stoc_bayes.reproduce.side_by_side import num_jobs, side_by_side, silent
from det2stoc_bayes.reproduce.work import Settings, Work

PRIMARY = "matched"
type Exact = Callable[[Work, int], dict[str, Any]]


def run_scene(
    name: str,
    scene: Scene,
    settings: Settings,
    out: Path,
    seed: int,
    progress: Progress,
    jobs: int = 0,
    alarms: Callable[[Work], dict[str, Any]] = lambda _: {},
    exact: Exact | None = None,
) -> dict[str, Any]:
    """Every model of every seed; each is kept in `out` as soon as it is done, and not done again.

    `exact`: what the simulator itself says of a seed's recordings. `jobs` processes make seeds, oracles and exact
    posteriors side by side (0: two, if there are cores).
    """
    work = Work(out, scene, settings, seed, progress)
    numbers = range(settings.num_seeds)
    exact = exact if settings.num_particles else None
    if (jobs := num_jobs(jobs)) > 1:
        exactly = [("exact", n) for n in numbers if exact]
        tasks = [*(("models", n) for n in numbers), ("oracles", 0), *exactly]
        total = num_models(settings) + 1 + len(exactly) * scene.real_episodes[settings.num_iterations - 1]
        first_simulations(work)
        make = partial(_made, replace(work, progress=silent), exact)
        side_by_side(make, tasks, jobs, out / "parts", total, progress)
    tested_psi, tested = _test_set(work)
    seeds = [{"seed": n, "models": Seed(work, n, tested).models()} for n in numbers]
    found = rows(seeds, scene.source)
    oracles = work.kept("oracles", lambda: _oracles(work, tested_psi, tested))
    exactly = [exact(work, n) for n in numbers] if exact else []
    simulators = {r["name"]: StochasticSimulator.load(work.saved(0, r["name"])) for r in found}
    return {
        "experiment": name,
        "seed": seed,
        "settings": asdict(settings),
        "oracles": oracles,
        "alarms": work.kept("alarms", lambda: {"priors": alarms(work)})["priors"],
        "table": _table(name, scene, found, oracles, settings),
        "populations": populations_table(scene, seeds, exactly),
        "exact": exactly,
        "rows": found,
        "seeds": seeds,
        "scene": {
            "title": scene.title, "names": scene.names, "units": scene.units, "state": scene.state,
            "shown": [scene.state[i] for i in scene.shown], "blocks": list(scene.blocks), "oracles": scene.oracles,
        },
        "truth": {"mean": scene.reality.loc, "sd": scene.reality.scale},
        "figures": work.kept("figures", lambda: figures(scene, tested, tested_psi, simulators, work.random(5))),
    }  # fmt: skip


def _made(work: Work, exact: Exact | None, task: tuple[str, int]) -> None:
    """One of the tasks that do not need each other, in a process of its own; its parts are kept."""
    kind, number = task
    if kind == "exact" and exact is not None:
        exact(work, number)
        return
    psi, tested = _test_set(work)
    if kind == "models":
        Seed(work, number, tested).models()
    else:
        work.kept("oracles", lambda: _oracles(work, psi, tested))


def _test_set(work: Work) -> tuple[Float[np.ndarray, "episodes psi"], Runs]:
    psi = work.scene.reality.draw(work.random(0), work.settings.num_test)
    return psi, work.simulate(psi, "simulating the test set", 0)


def rows(seeds: list[dict[str, Any]], source: Mapping[str, tuple[float, float]]) -> list[dict[str, Any]]:
    """Mean and sd over the seeds that have it of every model's metrics, beside the source's log likelihood."""
    out = []
    for name in seeds[0]["models"]:
        of_model = [s["models"][name] for s in seeds if name in s["models"]]
        values = {m: np.array([o["metrics"][m] for o in of_model]) for m in of_model[0]["metrics"]}
        spread = {m: [float(v.mean()), float(v.std(ddof=1)) if len(v) > 1 else None] for m, v in values.items()}
        about = {"name": name, "source": source.get(name)} | {k: of_model[0][k] for k in ("real", "variant")}
        out.append(about | {"metrics": spread})
    return out


def _table(
    name: str, scene: Scene, found: list[dict[str, Any]], oracles: Mapping[str, Any], settings: Settings
) -> dict[str, Any]:
    told = [
        [r["name"], str(r["real"]), *r["metrics"][PRIMARY], *r["metrics"]["mixture"], *(r["source"] or ["", ""])]
        for r in found
    ]
    told += [[f"oracle: psi from {text}", "", oracles[key], *[""] * 5] for key, text in scene.oracles.items()]
    return {
        "title": f"{name}, seeds: {settings.num_seeds}; log likelihood of the test set [nat a transition]",
        "columns": ["model", "real samples>", "matched Gaussian>", "sd>", "mixture>", "sd>", "source>", "sd>"],
        "rows": told,
    }


def _oracles(work: Work, tested_psi: np.ndarray, tested: Runs) -> dict[str, Any]:
    """What the simulator itself would score: of all of the state, and in `blocks` of its parts."""
    scene, settings, stage = work.scene, work.settings, partial(work.progress, "asking the oracle")
    psi = scene.reality.draw(work.random(4), max(settings.num_simulated, settings.num_oracle))
    count = settings.num_oracle
    found: dict[str, Any] = {"population": population_oracle(scene, tested, psi[:count], stage)}
    if "known" in scene.oracles:
        found["known"] = known_oracle(scene, tested, tested_psi, stage)
    rollouts = {}
    if scene.one_start:  # then episodes under other psi are draws of any
        states = work.simulate(psi, "simulating for the oracle", 4).states
        if "state" in scene.oracles and len(psi) >= 2 * NEIGHBOURS:  # a regression on fewer would be surer than it may
            found["state"] = state_oracle(scene, tested, psi, states, count, work.random(6), stage)
        rollouts = rollout_scores(states[: settings.num_draws, None], tested.states)
    told = {key: found[key]["all"] if key in found else None for key in scene.oracles}
    return told | {"blocks": {key: {n: v for n, v in f.items() if n != "all"} for key, f in found.items()}} | rollouts
