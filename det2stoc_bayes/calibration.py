"""Whether a method's posteriors hold the truth as often as they say: many replications, fitted and ranked.

Simulation-based calibration (Talts et al. 2018): psi from the prior, recordings simulated under it, a posterior of
them; the rank of each true unknown among the posterior's draws is uniform if the posterior is right. TARP (Lemos et al.
2023) asks the same of all unknowns together.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from pydantic import TypeAdapter, ValidationError

from det2stoc_bayes import coverage
from det2stoc_bayes.errors import Det2StocError, SamplingFailed, SimulationDiverged
from det2stoc_bayes.executors import finished
from det2stoc_bayes.files import appending
from det2stoc_bayes.posterior import DataTree
from det2stoc_bayes.psis import thinned

NUM_DRAWS = 99  # that a truth is ranked among: 100 ranks
MOST_TIMES = 8  # the draws of a fit are drawn again for, lest they be correlated
LEVEL = 0.01  # of all tests together
MOST_FAILED = 0.05  # share of the replications
MOST_FEW = 0.5  # share of the replications whose draws are worth too few
DIGITS = 9

type Replicate = Callable[[np.random.Generator], tuple[Any, Mapping[str, float]]]
type Fit = Callable[..., DataTree]  # (problem, key, num_samples=...)


@dataclass(frozen=True)
class Replication:
    """One truth, by unknown, and about independent draws of its posterior; or why there are none."""

    index: int
    truth: dict[str, float]
    draws: list[list[float]]  # of the truth's unknowns, in its order
    effective: float  # draws that the fit's were worth
    simulations: int = 0
    seconds: float = 0.0
    failed: str = ""


@dataclass(frozen=True)
class Experiment:
    """What a replication is made by: sent to workers, so that all of it can be pickled.

    `pose` gives what replicates a problem; `fit` draws from a problem's posterior, its draws in the group
    `unconstrained_posterior`.
    """

    pose: Callable[[], Replicate]
    fit: Fit
    seed: int
    num_samples: int

    def __call__(self, index: int) -> Replication:
        """Replication `index`, which follows from the seed and the index alone."""
        random = np.random.default_rng([self.seed, index])
        key = int(random.integers(2**62))
        problem, truth = self.pose()(random)
        try:
            tree, effective = self._enough(problem, key)
        except (SamplingFailed, SimulationDiverged) as error:
            return Replication(index, dict(truth), [], 0.0, failed=str(error))
        data = tree["unconstrained_posterior"].to_dataset()["z"].transpose("chain", "draw", "unknown")
        names = [str(n) for n in data["unknown"].values if str(n) in truth]
        if not names:
            raise Det2StocError(f"{tree.attrs['method']}: infers none of {', '.join(truth)}; allowed: another method")
        draws = np.asarray(data.sel(unknown=names).values, float).reshape(-1, len(names))
        told = {"simulations": int(tree.attrs["simulations"]), "seconds": float(tree.attrs["seconds_run"])}
        kept = [[round(v, DIGITS) for v in row] for row in thinned(draws, NUM_DRAWS).tolist()]
        return Replication(index, {n: truth[n] for n in names}, kept, effective, **told)

    def _enough(self, problem: Any, key: int) -> tuple[DataTree, float]:
        """A fit whose draws are worth NUM_DRAWS, if MOST_TIMES as many draws are."""
        num_samples = self.num_samples
        while True:
            tree = self.fit(problem, key, num_samples=num_samples)
            effective = _effective(tree)
            if effective >= NUM_DRAWS or num_samples >= MOST_TIMES * self.num_samples:
                return tree, effective
            wanted = num_samples * 1.3 * NUM_DRAWS / max(effective, 1.0)
            num_samples = int(np.clip(wanted, 1.5 * num_samples, MOST_TIMES * self.num_samples))


def _effective(tree: DataTree) -> float:
    """Draws that a fit's are worth, of the parameter of which they are worth least; 0 of chains that are too short."""
    from det2stoc_bayes.report.summary import summarize  # ArviZ's stand-in for numpyro must not come before numpyro

    return min((0.0 if row.ess is None else row.ess for row in summarize(tree)), default=0.0)


def run(
    prepare: Callable[[], Experiment],
    count: int,
    executor: Executor,
    path: Path,
    made: Mapping[str, Any],
    progress: Callable[[int, int], None] = lambda *_: None,
) -> list[Replication]:
    """Replications 0 to count - 1; those that the file `path` has of the same making are not done again.

    Each is a line of that file as soon as it is finished; `made` says what they follow from. `prepare` is called only
    if there is something to do.
    """
    mark = hashlib.sha256(json.dumps(dict(made), sort_keys=True).encode()).hexdigest()[:16]
    experiment = None if path.exists() else prepare()  # a method that cannot do it leaves no folder
    with appending(path) as (lines, append):
        done = {r.index: r for r in _read(lines, mark) if r.index < count}
        progress(len(done), count)
        missing = [i for i in range(count) if i not in done]
        for index, result in finished(executor, experiment or prepare(), missing) if missing else ():
            done[index] = result()
            append({"made": mark} | asdict(done[index]))
            progress(len(done), count)
    return [done[i] for i in range(count)]


def _read(lines: Iterable[Mapping[str, Any]], mark: str) -> list[Replication]:
    names = Replication.__dataclass_fields__
    known, whole = TypeAdapter(Replication), []
    for line in lines:
        if line.get("made") != mark:
            continue
        with suppress(ValidationError):  # a line that something else wrote is done again
            one = known.validate_json(json.dumps({n: line[n] for n in names if n in line}), strict=True)
            values = np.array([v for row in one.draws for v in row], float)
            whole += [one] if np.isfinite(values).all() and {*map(len, one.draws)} <= {len(one.truth)} else []
    return whole


@dataclass(frozen=True)
class Unknown:
    """What the ranks of one unknown say; p-values are corrected for the number of all tests."""

    name: str
    p_chi2: float
    p_uniform: float  # Kolmogorov and Smirnov
    mean: float  # of the ranks as shares of 1: 1/2 if right; below it the posteriors are too high
    spread: float  # of the ranks, 1 if right; above it the posteriors are too narrow
    sd: float  # of the posteriors, in prior sds: a method that ignores the recordings is calibrated, too
    rejected: bool
    shape: str  # how the ranks are off, in words


@dataclass(frozen=True, eq=False)
class Calibration:
    """What replications say of a method on a problem."""

    problem: str
    method: str
    trained_once: bool
    unknowns: tuple[Unknown, ...]
    p_tarp: float  # corrected for the number of all tests
    least_shift: float | None  # of posteriors that so many replications would find in four of five cases, in their sds
    least_narrowness: float | None  # times that they are too narrow, likewise
    ranks: Int[np.ndarray, "replications size"]
    credibility: Float[np.ndarray, " replications"]
    num_draws: int
    num_few: int  # replications whose draws were worth fewer than NUM_DRAWS
    failed: tuple[str, ...]
    simulations: int
    seconds: float
    seed: int

    @property
    def calibrated(self) -> bool:
        """Whether no test rejects, of replications that can be judged."""
        return not self.unjudged and self.p_tarp >= LEVEL and not any(u.rejected for u in self.unknowns)

    @property
    def shortage(self) -> str:
        """In how many replications draws are worth fewer than they are taken for; empty where in none."""
        if not self.num_few:
            return ""
        return f"In {self.num_few} replications the draws are worth fewer than {NUM_DRAWS} independent ones."

    @property
    def unjudged(self) -> str:
        """Why tests would say nothing, if so: those that were fitted are a choice, or draws are too few."""
        n, every = len(self.ranks), len(self.failed) + len(self.ranks)
        if len(self.failed) > MOST_FAILED * every:
            return f"{len(self.failed)} of {every} replications could not be fitted"
        if self.num_draws < NUM_DRAWS or self.num_few > MOST_FEW * n:
            few = f"{self.num_few} of {n} replications"
            return f"the draws of {few} are worth fewer than the {NUM_DRAWS} that are needed (more --num-samples)"
        return ""

    @property
    def power(self) -> str:
        """How wrong posteriors must be for so many replications to tell."""
        found = {"shifted by {} of their sds": self.least_shift, "{} times too narrow": self.least_narrowness}
        told = [words.format(f"{size:.2g}") for words, size in found.items() if size is not None]
        if not told:
            return "So few replications would not tell any posteriors that are wrong."
        return f"In four of five cases they would tell posteriors that are {' or '.join(told)}."

    @property
    def verdict(self) -> str:
        """What the tests say, in words."""
        n, of = len(self.ranks), f"{self.method} on {self.problem}"
        if self.unjudged:
            return f"{of} is not judged: {self.unjudged}."
        least = min([self.p_tarp, *(min(u.p_chi2, u.p_uniform) for u in self.unknowns)])
        if self.calibrated:
            told = f"no test of {n} replications rejects it at {LEVEL:.0%} (least p, corrected: {least:.2g})"
            return f"{of} is calibrated: {told}. {self.power}"
        wrong = [f"{u.name}'s posteriors are {u.shape}" for u in self.unknowns if u.rejected]
        wrong += ["its credible regions of all unknowns together miss their levels"] if self.p_tarp < LEVEL else []
        return f"{of} is not calibrated: {'; '.join(wrong)} (p = {least:.2g}, corrected, {n} replications)."


def judge(
    replications: Iterable[Replication], *, problem: str, method: str, trained_once: bool = False, seed: int = 0
) -> Calibration:
    """Tests of uniformity: two for each unknown and one for all together, corrected by Holm's method.

    Det2StocError: no replication could be fitted.
    """
    every = list(replications)
    fitted = [r for r in every if not r.failed]
    failed = tuple(r.failed for r in every if r.failed)
    if not fitted:
        raise Det2StocError(f"{method}: no replication could be fitted; the first: {failed[0]}")
    random = np.random.default_rng([seed, len(every), 1])
    names, num_draws = tuple(fitted[0].truth), min(len(r.draws) for r in fitted)
    truth = np.array([list(r.truth.values()) for r in fitted])
    draws = np.stack([np.array(r.draws)[:num_draws] for r in fitted])
    ranks = coverage.ranks(draws, truth)
    shares = coverage.fractions(ranks, num_draws, random)
    credibility = coverage.credibilities(draws, truth, random)
    tests = [coverage.rank_p_values(ranks, num_draws), coverage.uniform_p_values(shares)]
    p = coverage.holm(np.array([*tests[0], *tests[1], coverage.coverage_p_value(credibility)]))
    size = len(names)
    sds = draws.std(1, ddof=1).mean(0)
    rows = [_unknown(names[j], float(p[j]), float(p[size + j]), shares[:, j], float(sds[j])) for j in range(size)]
    few = sum(min(r.effective, len(r.draws)) < NUM_DRAWS for r in fitted)
    simulations, seconds = sum(r.simulations for r in fitted), sum(r.seconds for r in fitted)
    least = coverage.detectable(len(fitted), LEVEL / len(p), random)
    return Calibration(
        problem, method, trained_once, tuple(rows), float(p[-1]), *least, ranks, credibility, num_draws, few, failed,
        simulations, seconds, seed,
    )  # fmt: skip


def _unknown(
    name: str, p_chi2: float, p_uniform: float, shares: Float[np.ndarray, " replications"], sd: float
) -> Unknown:
    mean, spread = float(shares.mean()), float(12 * np.square(shares - 0.5).mean())
    rejected = min(p_chi2, p_uniform) < LEVEL
    return Unknown(name, p_chi2, p_uniform, mean, spread, sd, rejected, _shape(mean, spread, len(shares)))


def _shape(mean: float, spread: float, count: int) -> str:
    """How ranks are off, by the larger of two z scores: of their mean, and of their spread about 1/2."""
    shift, stretch = (mean - 0.5) * np.sqrt(12 * count), (spread - 1) * np.sqrt(180 * count) / 12
    if max(abs(shift), abs(stretch)) < 2:
        return "of another shape than they should be"
    if abs(stretch) > abs(shift):
        return "too narrow" if stretch > 0 else "too wide"
    return "too high" if shift < 0 else "too low"


def to_json(found: Calibration) -> dict[str, Any]:
    """All numbers, for a file or `--json`."""
    levels = np.round(np.linspace(0.05, 0.95, 19), 2)
    return {
        "problem": found.problem,
        "method": found.method,
        "trained_once": found.trained_once,
        "calibrated": found.calibrated,
        "verdict": found.verdict,
        "level": LEVEL,
        "least_shift": found.least_shift,
        "least_narrowness": found.least_narrowness,
        "num_replications": len(found.ranks) + len(found.failed),
        "failed": list(found.failed),
        "num_draws": found.num_draws,
        "num_few_effective": found.num_few,
        "unknowns": [asdict(u) for u in found.unknowns],
        "tarp": {
            "p": found.p_tarp,
            "levels": levels.tolist(),
            "coverage": coverage.expected_coverage(found.credibility, levels).tolist(),
        },
        "ranks": found.ranks.tolist(),
        "credibilities": found.credibility.tolist(),
        "simulations": found.simulations,
        "seconds_run": found.seconds,
        "seed": found.seed,
    }
