"""Windy Slope: a box on a slope in the wind, learned from few episodes by det2stoc and by a CVAE of its own."""

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.files import replacing
from det2stoc_bayes.inference._amortized import Iteration, Options, Population, baseline, iterate, marginal
from det2stoc_bayes.inference._cvae import Schedule
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models import windy_slope
from det2stoc_bayes.report.windy_slope_page import windy_slope_page as page
from det2stoc_bayes.reproduce.parts import Progress
from det2stoc_bayes.reproduce.windy_slope_alarm import alarms
from det2stoc_bayes.reproduce.windy_slope_figures import figures
from det2stoc_bayes.reproduce.windy_slope_scores import (
    NEIGHBOURS,
    population_oracle,
    rolled_out,
    rollout_scores,
    state_oracle,
    transition_scores,
)
from det2stoc_bayes.reproduce.windy_slope_work import REAL_EPISODES, Settings, Work
from det2stoc_bayes.transitions import Transitions

SOURCE = {
    "baseline 1000": (69.42, 1.73), "baseline 10000": (80.35, 0.60), "det2stoc 1": (66.93, 0.54),
    "det2stoc 2": (78.65, 0.53), "det2stoc 3": (81.74, 0.61),
}  # fmt: skip
NUM_LATENTS = len(windy_slope.NAMES)
PRIMARY = "matched"
MARGINAL = "det2stoc z integrated out"
ORACLES = {"population": "its population", "state": "p(psi | state)"}
__all__ = ["page", "run"]


def run(out: Path, *, seed: int = 0, quick: bool = False, progress: Progress = lambda *_: None) -> dict[str, Any]:
    """Every model of every seed; each is kept in `out` as soon as it is done, and not done again."""
    work = Work(out, Settings.quick() if quick else Settings(), seed, progress)
    settings = work.settings
    tested_psi = windy_slope.REALITY.draw(work.random(0), settings.num_test)
    tested = work.simulate(tested_psi, "simulating the test set")
    test = Transitions.of_episodes(tested)
    seeds = [_one_seed(work, number, tested, test) for number in range(settings.num_seeds)]
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
    """Mean and sd over seeds of every model's metrics, beside the source's log likelihood."""
    out = []
    for name in seeds[0]["models"]:
        of_model = [s["models"][name] for s in seeds]
        values = {m: np.array([o["metrics"][m] for o in of_model]) for m in of_model[0]["metrics"]}
        spread = {m: [float(v.mean()), float(v.std(ddof=1)) if len(v) > 1 else 0.0] for m, v in values.items()}
        out.append({"name": name, "real": of_model[0]["real"], "metrics": spread, "source": SOURCE.get(name)})
    return out


def _table(found: list[dict[str, Any]], oracles: Mapping[str, Any], settings: Settings) -> dict[str, Any]:
    def spread(pair: list[float]) -> list[float | None]:
        return [pair[0], pair[1] if settings.num_seeds > 1 else None]

    told = [
        [
            *(r["name"], str(r["real"]), *spread(r["metrics"][PRIMARY]), *spread(r["metrics"]["mixture"])),
            *(r["source"] or ["", ""]),
        ]
        for r in found
    ]
    told += [[f"oracle: psi from {name}", "", oracles[key], *[""] * 5] for key, name in ORACLES.items()]
    return {
        "title": f"windy-slope, seeds: {settings.num_seeds}; log likelihood of the test set [nat a transition]",
        "columns": ["model", "real samples>", "matched Gaussian>", "sd>", "mixture>", "sd>", "source>", "sd>"],
        "rows": told,
    }


def _one_seed(work: Work, number: int, tested: np.ndarray, test: Transitions) -> dict[str, Any]:
    """The baselines and the iterations of one seed's recordings."""
    psi, states = work.recorded(number)
    models: dict[str, Any] = {}

    def scored(simulator: StochasticSimulator, name: str, real: int) -> dict[str, Any]:
        simulator.save(work.saved(number, name))
        rolled = rolled_out(simulator, tested[0, 0], work.settings.num_draws, number)
        told = transition_scores(simulator, test, work.settings.num_draws, number)
        return {"real": real, "metrics": told | rollout_scores(rolled, tested)}

    for episodes in work.settings.baselines:
        real = Transitions.of_episodes(states[:episodes])
        name = f"baseline {len(real)}"

        def learn(real: Transitions = real, name: str = name) -> dict[str, Any]:
            steps = Schedule(work.settings.baseline_steps, batch=256, learning_rate=2e-3)
            made, history = baseline(real, NUM_LATENTS, jax.random.key(number), Options(baseline=steps), work.progress)
            return scored(made, name, len(real)) | {"steps": history[-1][0]}

        models[name] = work.model(number, name, learn)
    believed: Population | None = None
    for turn in range(work.settings.num_iterations):
        count, name = REAL_EPISODES[turn], f"det2stoc {turn + 1}"

        def turned(count: int = count, name: str = name, believed=believed, turn: int = turn) -> dict[str, Any]:
            found = _iteration(work, Transitions.of_episodes(states[:count]), believed, number, turn)
            drawn = {"mean": psi[:count].mean(0).tolist(), "sd": psi[:count].std(0, ddof=1).tolist()}
            return scored(found.simulator, name, count * windy_slope.NUM_STEPS) | told(found) | {"drawn": drawn}

        models[name] = work.model(number, name, turned)
        believed = Population(*(np.array(models[name]["next"][k]) for k in ("loc", "scale")))
    last = work.settings.num_iterations

    def integrated(believed: Population | None = believed) -> dict[str, Any]:
        assert believed is not None  # there is one iteration at least
        _, simulated = _simulated(work, believed, number, last)
        options = Options(decoder=Schedule(work.settings.first_steps, batch=1000, learning_rate=5e-3))
        made, _ = marginal(simulated, jax.random.key(100 * number + last), options, work.progress)
        return scored(made, MARGINAL, REAL_EPISODES[last - 1] * windy_slope.NUM_STEPS)

    models[MARGINAL] = work.model(number, MARGINAL, integrated)
    return {"seed": number, "models": models}


def _iteration(work: Work, real: Transitions, believed: Population | None, number: int, turn: int) -> Iteration:
    """One turn of the algorithm, from psi_0 where nothing is believed yet."""
    steps = work.settings.decoder_steps if turn else work.settings.first_steps
    if believed is None:
        psi, simulated = _first(work)
        believed = Population(psi.mean(0), psi.std(0))
    else:
        psi, simulated = _simulated(work, believed, number, turn)
    options = Options(decoder=Schedule(steps, batch=1000, learning_rate=5e-3))
    each, key = np.repeat(psi, windy_slope.NUM_STEPS, 0), jax.random.key(100 * number + turn)
    return iterate(real, simulated, each, believed, key, options, work.progress)


def _simulated(
    work: Work, believed: Population, number: int, turn: int
) -> tuple[Float[np.ndarray, "episodes 3"], Transitions]:
    """psi of a population, and episodes under them."""
    z = work.random(2, number, turn).standard_normal((work.settings.num_simulated, NUM_LATENTS))
    psi = believed.loc + believed.scale * z
    psi[:, 0] = np.maximum(psi[:, 0], windy_slope.LEAST_FRICTION)
    return psi, Transitions.of_episodes(work.simulate(psi, "simulating"))


def told(found: Iteration) -> dict[str, Any]:
    """An iteration's posteriors as plain lists."""
    after = found.next_population
    return {
        "next": {"loc": after.loc.tolist(), "scale": after.scale.tolist()},
        "pooled": {"mean": found.pooled.loc.tolist(), "sd": found.pooled.scale.tolist()},
        "pooled_draws": found.pooled_draws.T.tolist(),
        "population": {
            "mean": found.mean_draws.mean(0).tolist(),
            "mean_sd": found.mean_draws.std(0).tolist(),
            "sd": found.sd_draws.mean(0).tolist(),
            "sd_sd": found.sd_draws.std(0).tolist(),
        },
        "episodes": found.episode_means.tolist(),
        "divergences": found.divergences.tolist(),
    }


def _first(work: Work) -> tuple[Float[np.ndarray, "episodes 3"], Transitions]:
    """psi_0 and its simulations."""
    path = work.out / "parts" / f"psi_0_{work.seed}_{work.settings.num_first}.npz"
    if not path.is_file():
        psi = windy_slope.PRIOR.draw(work.random(3), work.settings.num_first)
        states = work.simulate(psi, "simulating psi_0")
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, psi=psi, states=states)
    data = np.load(path)
    return data["psi"], Transitions.of_episodes(data["states"])


def _oracles(work: Work, tested: np.ndarray, test: Transitions) -> dict[str, Any]:
    """What the simulator itself would score."""
    settings, stage = work.settings, partial(work.progress, "asking the oracle")
    psi = windy_slope.REALITY.draw(work.random(4), max(settings.num_simulated, settings.num_oracle))
    states = work.simulate(psi, "simulating for the oracle")
    ask, few = windy_slope.simulate, settings.num_oracle // 3
    enough = len(psi) >= 2 * NEIGHBOURS  # a regression on fewer would be surer than it may be
    return {
        "population": population_oracle(test, psi[: settings.num_oracle], ask, stage),
        "state": state_oracle(test, psi, states, few, work.random(6), ask, stage) if enough else None,
        **rollout_scores(states[: settings.num_draws], tested),
    }
