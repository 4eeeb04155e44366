"""Posteriors of one problem by several methods beside each other: against a reference, and what speaks for each."""

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.doubts import weights
from det2stoc_bayes.executors import Here, Progress, finished
from det2stoc_bayes.posterior import DataTree
from det2stoc_bayes.psis import bfmi, leave_one_out, thinned
from det2stoc_bayes.report.summary import summarize
from det2stoc_bayes.run_statistics import autocorrelation_times, divergences, energies, predictive_p, surprise_p
from det2stoc_bayes.two_samples import distances, gaussian_kl
from det2stoc_bayes.vector_density import Inferred
from det2stoc_bayes.verdicts import Verdict, is_near, shortcomings, verdict_of

AGREE = 0.55  # C2ST of two samplers of the same posterior
MOST_DRAWS, LEAST_WORTH = 4000, 10  # that distances are taken from
HOLDING = "holding runs against the reference"

Kind = Literal["exact", "approximate", "no posterior"]


@dataclass(frozen=True, eq=False)
class Run:
    """A method's result, and what its draws are: the posterior's once they have converged, about so, or others."""

    label: str
    tree: DataTree
    kind: Kind

    @property
    def draws(self) -> Float[np.ndarray, "draws size"] | None:
        """Unconstrained draws of all chains; None of a method that infers no psi."""
        if "unconstrained_posterior" not in self.tree.children:
            return None
        z = self.tree["unconstrained_posterior"].to_dataset()["z"].transpose("chain", "draw", "unknown").values
        return np.asarray(z, float).reshape(-1, z.shape[-1])

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the columns of `draws`."""
        if "unconstrained_posterior" not in self.tree.children:
            return ()
        return tuple(str(n) for n in self.tree["unconstrained_posterior"].to_dataset()["unknown"].values)


def _draws_of(run: Run) -> Float[np.ndarray, "draws size"]:
    """Draws of a method that infers psi."""
    assert run.draws is not None
    return run.draws


@dataclass(frozen=True, eq=False)
class Reference:
    """Draws that all others are held against, and the exact runs that agree with those or contradict them."""

    label: str
    draws: Float[np.ndarray, "draws size"]
    unknowns: tuple[str, ...]
    gaussian: tuple[Float[np.ndarray, " size"], Float[np.ndarray, "size size"]] | None = None  # its closed form
    named: Mapping[str, Float[np.ndarray, " draws"]] | None = None  # of that, the draws in their own units
    agreeing: tuple[str, ...] = ()
    contradicting: tuple[str, ...] = ()


def known_reference(
    mean: Float[np.ndarray, " size"], covariance: Float[np.ndarray, "size size"], problem: Inferred, seed: int
) -> Reference:
    """A problem's posterior that is known in closed form, with draws of it."""
    random = np.random.default_rng([seed, 1, 1])  # no method's own numbers, whose draws would be these
    draws = random.multivariate_normal(mean, covariance, MOST_DRAWS)
    named = {name: np.asarray(values) for name, values in problem.constrained(draws).items()}
    return Reference("the closed form", draws, tuple(problem.names), (mean, covariance), named)


@dataclass(frozen=True)
class Row:
    """What is known of one run; None where it does not apply."""

    label: str
    kind: Kind
    num_draws: int
    r_hat: float | None
    ess: float | None
    divergences: int | None
    bfmi: float | None  # the worst chain's
    autocorrelation_times: float | None
    k_hat: float | None
    num_weighed: int
    refined: bool
    c2st: float | None
    wasserstein: float | None
    kl: float | None  # of Gaussians with the draws' moments from a reference of closed form [nat]
    mean_error: float | None  # the largest, in the reference's sds
    sd_error: float | None  # the largest, relative
    predictive_p: float | None  # of the squared misfit, at the posterior's draws
    surprise_p: float | None  # of the recordings among the simulations that an amortized method learned from
    elpd: float | None  # leave-one-recording-out
    elpd_error: float | None
    elpd_k_hat: float | None
    seconds_compile: float
    seconds_run: float
    simulations: int
    gradients: int
    verdict: Verdict = "no posterior"
    why: str = ""

    @property
    def ess_per_second(self) -> float | None:
        """Compilation counted."""
        return None if self.ess is None else self.ess / max(self.seconds_compile + self.seconds_run, 1e-9)


@dataclass(frozen=True, eq=False)
class Comparison:
    """All rows, in the runs' order; methods that could not run, by label, with the reason."""

    runs: tuple[Run, ...]
    rows: tuple[Row, ...]
    reference: Reference | None
    failed: Mapping[str, str]
    replaced: tuple[str, ...] = ()  # of earlier runs, each with a reason


def compare(
    runs: Sequence[Run],
    reference: Reference | None = None,
    failed: Mapping[str, str] = MappingProxyType({}),
    replaced: tuple[str, ...] = (),
    executor: Executor | None = None,
    progress: Progress = lambda *_: None,
) -> Comparison:
    """Rows of all runs; without a reference of the problem's own the best exact run that passes the gates is it.

    `executor` holds several against it at a time (None: this process, one after the other). Raises ValueError for
    a label that is there twice.
    """
    twice = [label for label, number in Counter(run.label for run in runs).items() if number > 1]
    if twice:
        raise ValueError(f"runs labelled {', '.join(twice)} are there more than once; allowed: a label of its own each")
    known = {run.label: _described(run) for run in runs}
    chosen = reference is None
    reference = reference or _chosen(runs, known)
    held = [] if reference is None else [run for run in runs if _comparable(run, reference)]
    if reference is not None and held:
        progress(HOLDING, 0, len(held))
        each = [(r.label, thinned(_draws_of(r), MOST_DRAWS), _worth(known[r.label])) for r in held]
        measured = finished(executor or Here(), partial(_distances, reference.draws), each)
        for done, ((label, *_), found) in enumerate(measured, 1):
            known[label] = replace(known[label], **found())
            progress(HOLDING, done, len(held))
        if reference.gaussian is not None:
            kl = {r.label: gaussian_kl(_draws_of(r), *reference.gaussian) for r in held}
            known |= {label: replace(known[label], kl=value) for label, value in kl.items()}
        reference = _with_judges(reference, known) if chosen else reference
    rows = [_judged(known[run.label], reference) for run in runs]
    return Comparison(tuple(runs), tuple(rows), reference, failed, replaced)


def _described(run: Run) -> Row:
    """What a run says of itself."""
    tree, attributes = run.tree, run.tree.attrs
    rows = summarize(tree)
    r_hats, sizes = ([v for r in rows if (v := getattr(r, name)) is not None] for name in ("r_hat", "ess"))
    k_hat, num_weighed = weights(tree) or (None, 0)
    stands = run.kind == "exact" or "k_hat" in attributes  # of other draws it would be no score of the posterior
    terms = tree["log_likelihood"].to_dataset()["values"].values if stands else None
    elpd = None if terms is None else leave_one_out(terms)
    return Row(
        label=run.label,
        kind=run.kind,
        num_draws=0 if run.draws is None else len(run.draws),
        r_hat=max(r_hats, default=None),
        ess=min(sizes) if len(sizes) == len(rows) and rows else None,
        divergences=divergences(tree),
        bfmi=bfmi(energy) if (energy := energies(tree)) is not None else None,
        autocorrelation_times=autocorrelation_times(tree),
        k_hat=k_hat,
        num_weighed=num_weighed,
        refined="k_hat" in attributes,
        **dict.fromkeys(("c2st", "wasserstein", "kl", "mean_error", "sd_error")),
        predictive_p=predictive_p(tree) if stands else None,
        surprise_p=surprise_p(tree),
        **dict(zip(("elpd", "elpd_error", "elpd_k_hat"), elpd or (None,) * 3, strict=True)),
        seconds_compile=float(attributes["seconds_compile"]),
        seconds_run=float(attributes["seconds_run"]),
        simulations=int(attributes["simulations"]),
        gradients=int(attributes["gradients"]),
    )


def _chosen(runs: Sequence[Run], known: Mapping[str, Row]) -> Reference | None:
    """The exact run that passes the gates with most effective draws."""
    passed = [run for run in runs if _passes(known[run.label])]
    if not passed:
        return None
    best = max(passed, key=lambda run: known[run.label].ess or 0.0)
    return Reference(best.label, thinned(_draws_of(best), _worth(known[best.label])), best.unknowns)


def _passes(row: Row) -> bool:
    return row.kind == "exact" and not shortcomings(row)


def _with_judges(reference: Reference, known: Mapping[str, Row]) -> Reference:
    """A run as the reference, with what the other exact runs that pass the gates say of it."""
    others = [row for label, row in known.items() if label != reference.label and _passes(row)]
    agreeing = tuple(r.label for r in others if r.c2st is not None and r.c2st < AGREE and is_near(r))
    contradicting = tuple(r.label for r in others if r.c2st is not None and not is_near(r))
    return replace(reference, agreeing=agreeing, contradicting=contradicting)


def _comparable(run: Run, reference: Reference) -> bool:
    """Whether a run can be held against the reference: not against itself, nor against other unknowns."""
    return run.label != reference.label and run.kind != "no posterior" and run.unknowns == reference.unknowns


def _distances(reference: np.ndarray, held: tuple[str, Float[np.ndarray, "draws size"], int]) -> dict[str, float]:
    return distances(held[1], reference, held[2])


def _worth(row: Row) -> int:
    """Draws that a run's are worth, MOST_DRAWS at most."""
    return min(MOST_DRAWS, row.num_draws if row.ess is None else max(int(row.ess), LEAST_WORTH))


def _judged(row: Row, reference: Reference | None) -> Row:
    verdict, why = verdict_of(row, reference)
    return replace(row, verdict=verdict, why=why)
