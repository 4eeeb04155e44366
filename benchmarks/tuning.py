"""Whether Windy Slope's models are tuned alike: one grid of widths and learning rates, on episodes of their own.

Recordings, simulations and validation episodes belong to no seed of `det2stoc reproduce windy-slope`. Every line goes
to benchmarks/results/tuning.jsonl; the same command at the same commit goes on where it stopped.
"""

import itertools
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from logs import append, logged

from det2stoc_bayes.blind.proof import revision
from det2stoc_bayes.inference._amortized import Options, Population, baseline, iterate
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models._runs import Runs
from det2stoc_bayes.reproduce.scores import transition_scores
from det2stoc_bayes.reproduce.windy_slope_scene import SCENE
from det2stoc_bayes.reproduce.work import Settings, Work

LOG = Path(__file__).parent / "results" / "tuning.jsonl"
SEED = 99  # of everything here
WIDTHS, FACTORS = (32, 64), (0.3, 1.0, 3.0)  # of the networks, and of the learning rates that `Options` has
NUM_FIRST, NUM_SIMULATED, NUM_VALIDATION, NUM_DRAWS = 2_000, 1_200, 30, 500
DECODER_STEPS = 6_000
TURNS = 3
WAYS = ("matched", "mixture", "one_latent")


def point(width: int, factor: float) -> Options:
    """The defaults with another width, also where recordings are few, and other learning rates."""
    base = Options.decoding(DECODER_STEPS)
    rates = {
        name: replace(getattr(base, name), learning_rate=factor * getattr(base, name).learning_rate)
        for name in ("decoder", "encoder", "baseline")
    }
    return replace(base, width=width, few=(base.few[0], width), **rates)


def drawn(work: Work, psi: np.ndarray) -> tuple[np.ndarray, Runs]:
    """psi of every transition, and episodes under them."""
    return np.repeat(psi, SCENE.num_steps, 0), work.simulate(psi, "simulating")


def learned(work: Work, options: Options) -> Iterator[tuple[str, StochasticSimulator]]:
    """Both baselines, and the algorithm's third turn from ever more recordings, as the source has it."""
    runs = work.recorded(0)
    key = work.key("tuning")
    for episodes in work.settings.baselines:
        made, _ = baseline(runs[:episodes].transitions, 3, key, options, work.progress)
        yield f"baseline {episodes * SCENE.num_steps}", made
    psi = SCENE.prior.draw(work.random(3), NUM_FIRST)
    believed = Population.of(psi)
    for turn in range(TURNS):
        real, (each, simulated) = runs[: SCENE.real_episodes[turn]].transitions, drawn(work, psi)
        found = iterate(
            real, simulated.transitions, each, believed, jax.random.fold_in(key, turn), options, work.progress
        )
        believed = found.next_population
        psi = SCENE.drawn(believed, work.random(2, turn), NUM_SIMULATED)
    yield f"det2stoc {TURNS}", found.simulator


def lines(commit: str, width: int, factor: float) -> Iterator[dict[str, Any]]:
    """Scores of a grid point's models on the validation episodes."""
    with tempfile.TemporaryDirectory() as folder:
        work = Work(Path(folder), SCENE, Settings(), SEED, lambda *_: None)
        _, validation = drawn(work, SCENE.reality.draw(work.random(0), NUM_VALIDATION))
        began = time.perf_counter()
        for name, simulator in learned(work, point(width, factor)):
            scores = transition_scores(simulator, validation.transitions, NUM_DRAWS, work.key("scores"))
            seconds = round(time.perf_counter() - began, 1)
            about = {"commit": commit, "width": width, "factor": factor, "model": name, "seconds": seconds}
            yield about | {way: scores[way] for way in WAYS}
            began = time.perf_counter()


def main() -> int:
    """Every point of the grid that is not in the log."""
    commit = revision()
    done = [line for line in logged(LOG) if line["commit"] == commit]
    print("| model | width | learning rates | matched Gaussian | mixture | one z | s |\n|---|---|---|---|---|---|---|")
    for width, factor in itertools.product(WIDTHS, FACTORS):
        mine = [line for line in done if (line["width"], line["factor"]) == (width, factor)]
        if not mine:
            mine = list(lines(commit, width, factor))
            for line in mine:
                append(LOG, line)
        for line in mine:
            told = " | ".join(f"{line[way]:.1f}" for way in WAYS)
            print(f"| {line['model']} | {width} | x {factor} | {told} | {line['seconds']:.0f} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
