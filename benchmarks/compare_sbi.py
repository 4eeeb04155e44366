"""Neural posterior estimation on problems of the SBI benchmark (Lueckmann et al. 2021), by the benchmark's own measure.

Observations and reference posteriors are read from the files of the package sbibm; C2ST of 10,000 draws against
10,000, for each of ten observations. One network a line serves all of them; `npe+psis` resamples 100,000 of its draws
by the exact likelihood. det2stoc's CVAE stands beside it as it is. Lines go to benchmarks/results/compare_sbi.jsonl;
the same command goes on where it stopped.
"""

import argparse
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib import util
from pathlib import Path
from typing import Any

import jax
import numpy as np
from cvae_of_vectors import train as train_cvae
from logs import append, logged
from two_samples_jax import c2sts

from det2stoc_bayes.blind.proof import revision
from det2stoc_bayes.inference._amortized import Options
from det2stoc_bayes.inference._flow import ConditionalFlow, train
from det2stoc_bayes.inference._vectors import refined
from det2stoc_bayes.models import vector_problem
from det2stoc_bayes.psis import reliable
from det2stoc_bayes.vector_problem import VectorProblem

LOG = Path(__file__).parent / "results" / "compare_sbi.jsonl"
PROBLEMS = ("two_moons", "slcp", "gaussian_linear")
BUDGETS = (1_000, 10_000, 100_000)
WAYS = "npe", "npe+psis"
NUM_DRAWS, NUM_PROPOSED, NUM_OBSERVATIONS = 10_000, 100_000, 10
PUBLISHED = {  # mean C2ST of NPE, by the number of simulations
    "gaussian_linear": (0.694, 0.552, 0.506),
    "two_moons": (0.725, 0.606, 0.542),
    "slcp": (0.975, 0.901, 0.831),
}


def files_of(name: str, observation: int) -> Path:
    """The benchmark's folder of one observation (1 to 10); sbibm itself, which wants PyTorch, is not imported."""
    found = util.find_spec("sbibm")
    if found is None or not found.submodule_search_locations:
        raise SystemExit("error: sbibm is not installed; allowed: the environment that make builds")
    return Path(found.submodule_search_locations[0]) / "tasks" / name / "files" / f"num_observation_{observation}"


def table(path: Path) -> np.ndarray:
    """A table's rows without its header; of numpy's readers one unpacks .bz2, too."""
    return np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)


def drawn(problem: VectorProblem, flow: ConditionalFlow, observation: int, seed: int) -> dict[str, Any]:
    """Draws of one observation's posterior in theta, as the benchmark has them, beside the reference's."""
    folder = files_of(problem.name, observation)
    x = table(folder / "observation.csv")[0]
    own, other = jax.random.split(jax.random.fold_in(jax.random.key(seed), observation))
    draws, k_hat, effective = refined(problem, flow, x, other, NUM_DRAWS, NUM_PROPOSED)
    return {
        "npe": problem.constrained(flow.sample(own, x, NUM_DRAWS)),
        "npe+psis": problem.constrained(draws),
        "reference": table(folder / "reference_posterior_samples.csv.bz2"),
        "k_hat": round(k_hat, 3),
        "effective": round(effective, 1),
    }


def line(name: str, budget: int, seed: int) -> dict[str, Any]:
    """One training and its ten observations."""
    problem = vector_problem(name)
    z, x = problem.draw(budget, np.random.default_rng([seed, budget]))
    began = time.perf_counter()
    flow = train(z, x, jax.random.key(seed))
    seconds = time.perf_counter() - began
    found = [drawn(problem, flow, k, seed) for k in range(1, NUM_OBSERVATIONS + 1)]
    columns = {key: [one[key] for one in found] for key in ("k_hat", "effective")}
    reference = np.stack([one["reference"] for one in found])
    for way in WAYS:
        scores = c2sts(reference, np.stack([one[way] for one in found]))
        columns[way] = [round(float(value), 4) for value in scores]
    about = {"seconds": round(seconds, 1), "epochs": len(flow.history), "device": jax.devices()[0].device_kind}
    return about | columns


def line_of_cvae(name: str, budget: int, seed: int) -> dict[str, Any]:
    """det2stoc's CVAE, trained once, on the ten observations."""
    problem = vector_problem(name)
    z, x = problem.draw(budget, np.random.default_rng([seed, budget]))
    began = time.perf_counter()
    learned = train_cvae(z, x, jax.random.key(seed), Options(full=True))
    seconds = time.perf_counter() - began
    found, reference = [], []
    for k in range(1, NUM_OBSERVATIONS + 1):
        key, folder = jax.random.fold_in(jax.random.key(seed), k), files_of(name, k)
        draws = learned.sample(key, table(folder / "observation.csv")[0], NUM_DRAWS)
        found.append(problem.constrained(draws))
        reference.append(table(folder / "reference_posterior_samples.csv.bz2"))
    scores = [round(float(value), 4) for value in c2sts(np.stack(reference), np.stack(found))]
    return {"seconds": round(seconds, 1), "device": jax.devices()[0].device_kind, "det2stoc": scores}


def summary(lines: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """A row a problem and number of simulations: mean C2ST and its standard error over observations.

    Seconds are an accelerator's where some fit ran on one.
    """
    titles = "problem", "simulations", "npe", "npe + PSIS", "k-hat too high", "published", "seeds", "s a fit"
    yield f"| {' | '.join([*titles, "det2stoc's CVAE", 'seeds'])} |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for name, (k, budget) in itertools.product(PROBLEMS, enumerate(BUDGETS)):
        mine = [x for x in lines if x["problem"] == name and x["simulations"] == budget]
        own = list({x["seed"]: x for x in mine if "npe" in x}.values())
        beside = list({x["seed"]: x for x in mine if "det2stoc" in x}.values())
        if own:
            cells = [_mean([one[way] for one in own]) for way in WAYS]
            k_hat = np.mean([one["k_hat"] for one in own], 0)
            cells += [f"{(k_hat > reliable(NUM_PROPOSED)).sum()} of {len(k_hat)}"]
            accelerated = [one["seconds"] for one in own if one.get("device", "cpu") != "cpu"]
            seconds = np.mean(accelerated or [one["seconds"] for one in own])
            published = f"{PUBLISHED[name][k]:.3f}"
            row = [name, str(budget), *cells, published, str(len(own)), f"{seconds:.0f}"]
            row += [_mean([one["det2stoc"] for one in beside]) if beside else "", str(len(beside))]
            yield f"| {' | '.join(row)} |"


def _mean(scores: Sequence[Sequence[float]]) -> str:
    """Mean and its standard error over observations; seeds of one observation are no further evidence."""
    values = np.mean(scores, 0)
    return f"{values.mean():.3f} ± {values.std(ddof=1) / np.sqrt(values.size):.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=PROBLEMS)
    parser.add_argument("--simulations", nargs="+", type=int, choices=BUDGETS, default=BUDGETS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--log", type=Path, default=LOG)
    given = parser.parse_args()
    makers = {"npe": line, "det2stoc": line_of_cvae}
    done = {(method, one["problem"], one["simulations"], one["seed"]) for one in logged(given.log) for method in one}
    for seed in range(given.seeds):
        for budget, name in itertools.product(given.simulations, given.problems):
            for method, make in makers.items():
                if (method, name, budget, seed) not in done:
                    found = make(name, budget, seed)
                    about = {"commit": revision(), "problem": name, "simulations": budget, "seed": seed}
                    append(given.log, about | found)
                    print(f"{method}, {name}, {budget}, seed {seed}: {np.mean(found[method]):.3f}", flush=True)
    print(*summary(logged(given.log)), sep="\n")


if __name__ == "__main__":
    main()
