"""Posteriors of one problem by several methods beside each other: against a reference, and what speaks for each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.posterior import DataTree
from det2stoc_bayes.psis import leave_one_out, reliable, smooth
from det2stoc_bayes.report.summary import summarize
from det2stoc_bayes.two_samples import c2st, mean_errors, sd_errors, sliced_wasserstein

MOST_R_HAT, LEAST_ESS, LEAST_TIMES = 1.01, 400, 50  # gates of an exact run: chains, draws, autocorrelation times
AGREE = 0.55  # C2ST of two samplers of the same posterior
NEAR = (0.6, 0.2, 0.2)  # C2ST, error of means in sds, relative error of sds: an approximation that may stand for it
MOST_DRAWS = 4000  # that distances are taken from

Verdict = Literal["trust", "trust after refinement", "do not trust", "no posterior"]


@dataclass(frozen=True, eq=False)
class Run:
    """A method's result; `exact`: whether its draws are those of the posterior once it has converged."""

    label: str
    tree: DataTree
    exact: bool

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


@dataclass(frozen=True, eq=False)
class Reference:
    """Draws that all others are held against, and the samplers that agree with those."""

    label: str
    draws: Float[np.ndarray, "draws size"]
    agreeing: tuple[str, ...] = ()


@dataclass(frozen=True)
class Row:
    """What is known of one run; None where it does not apply."""

    label: str
    exact: bool
    num_draws: int
    r_hat: float | None
    ess: float | None
    divergences: int | None
    autocorrelation_times: float | None
    k_hat: float | None
    num_weighed: int
    refined: bool
    c2st: float | None
    wasserstein: float | None
    mean_error: float | None  # the largest, in the reference's sds
    sd_error: float | None  # the largest, relative
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
    """All rows, in the runs' order."""

    runs: tuple[Run, ...]
    rows: tuple[Row, ...]
    reference: Reference | None


def compare(runs: Sequence[Run], reference: Reference | None = None) -> Comparison:
    """Rows of all runs; without a reference of the problem's own the best exact run that passes the gates is it."""
    known = [_described(run) for run in runs]
    reference = reference or _chosen(runs, known)
    rows = [_judged(_held_against(run, row, reference), reference) for run, row in zip(runs, known, strict=True)]
    return Comparison(tuple(runs), tuple(rows), reference)


def shortcomings(row: Row) -> list[str]:
    """The gates that an exact run does not pass, each with what was found and what is allowed."""
    found = []
    if row.r_hat is not None and not row.r_hat < MOST_R_HAT:
        found.append(f"R-hat is {row.r_hat:.3g} (allowed: below {MOST_R_HAT})")
    if row.autocorrelation_times is not None and not row.autocorrelation_times > LEAST_TIMES:
        found.append(f"{row.autocorrelation_times:.3g} autocorrelation times (allowed: more than {LEAST_TIMES})")
    if row.ess is None or row.ess < LEAST_ESS:
        said = "no effective draws" if row.ess is None else f"{row.ess:.0f} effective draws"
        found.append(f"{said} (allowed: at least {LEAST_ESS})")
    if row.divergences:
        found.append(f"{row.divergences} divergences (allowed: none)")
    return found


def _described(run: Run) -> Row:
    """What a run says of itself."""
    tree, attributes = run.tree, run.tree.attrs
    rows = summarize(tree)
    r_hats, sizes = ([v for r in rows if (v := getattr(r, name)) is not None] for name in ("r_hat", "ess"))
    k_hat, num_weighed = _weights(tree)
    terms = tree["log_likelihood"].to_dataset()["values"].values if "log_likelihood" in tree.children else None
    elpd = None if terms is None else leave_one_out(terms)
    return Row(
        label=run.label,
        exact=run.exact,
        num_draws=0 if run.draws is None else len(run.draws),
        r_hat=max(r_hats, default=None),
        ess=min(sizes) if len(sizes) == len(rows) and rows else None,
        divergences=_divergences(tree),
        autocorrelation_times=_times(tree),
        k_hat=k_hat,
        num_weighed=num_weighed,
        refined="k_hat" in attributes,
        **dict.fromkeys(("c2st", "wasserstein", "mean_error", "sd_error")),
        **dict(zip(("elpd", "elpd_error", "elpd_k_hat"), elpd or (None,) * 3, strict=True)),
        seconds_compile=float(attributes["seconds_compile"]),
        seconds_run=float(attributes["seconds_run"]),
        simulations=int(attributes["simulations"]),
        gradients=int(attributes["gradients"]),
    )


def _has(tree: DataTree, group: str, name: str) -> bool:
    return group in tree.children and name in tree[group].to_dataset()


def _divergences(tree: DataTree) -> int | None:
    if not _has(tree, "sample_stats", "diverging"):
        return None
    return int(tree["sample_stats"].to_dataset()["diverging"].values.sum())


def _times(tree: DataTree) -> float | None:
    """Autocorrelation times that an ensemble has run for."""
    if not _has(tree, "sample_stats", "autocorrelation_time"):
        return None
    stats = tree["sample_stats"].to_dataset()
    return float(stats["steps"]) / float(stats["autocorrelation_time"].max())


def _weights(tree: DataTree) -> tuple[float | None, int]:
    """k-hat of a run's importance weights, and how many there were."""
    if "k_hat" in tree.attrs:
        return float(tree.attrs["k_hat"]), int(tree.attrs["num_weighed"])
    if not _has(tree, "sample_stats", "log_weight"):
        return None, 0
    weights = np.asarray(tree["sample_stats"]["log_weight"].values, float).ravel()
    return smooth(weights)[1], len(weights)


def _chosen(runs: Sequence[Run], rows: Sequence[Row]) -> Reference | None:
    """The exact run that passes the gates with most effective draws."""
    passed = [(row.ess or 0.0, run) for run, row in zip(runs, rows, strict=True) if run.exact and not shortcomings(row)]
    if not passed:
        return None
    best = max(passed, key=lambda p: p[0])[1]
    others = [run for _, run in passed if run is not best and run.unknowns == best.unknowns]
    agreeing = [o.label for o in others if c2st(_some(o.draws), _some(best.draws)) < AGREE]
    return Reference(best.label, _some(best.draws), tuple(agreeing))


def _some(draws: Float[np.ndarray, "_ size"] | None) -> Float[np.ndarray, "_ size"]:
    """At most so many draws, evenly spread."""
    assert draws is not None
    return draws[np.linspace(0, len(draws) - 1, min(len(draws), MOST_DRAWS)).round().astype(int)]


def _held_against(run: Run, row: Row, reference: Reference | None) -> Row:
    """With its distances from the reference; a run is not held against itself."""
    if reference is None or run.draws is None or run.label == reference.label or not run.draws.shape[1]:
        return row
    if run.draws.shape[1] != reference.draws.shape[1]:
        return row
    draws = _some(run.draws)
    return replace(
        row,
        c2st=c2st(draws, reference.draws),
        wasserstein=sliced_wasserstein(draws, reference.draws),
        mean_error=float(np.abs(mean_errors(draws, reference.draws)).max()),
        sd_error=float(np.abs(sd_errors(draws, reference.draws)).max()),
    )


def _judged(row: Row, reference: Reference | None) -> Row:
    if not row.num_draws:
        return replace(row, why="it predicts, and infers no psi")
    verdict, why = _exact_verdict(row, reference) if row.exact else _verdict(row, reference)
    return replace(row, verdict=verdict, why=why)


def _exact_verdict(row: Row, reference: Reference | None) -> tuple[Verdict, str]:
    failed = shortcomings(row)
    if failed:
        return "do not trust", "; ".join(failed)
    if reference is None or row.label == reference.label:
        others = reference.agreeing if reference else ()
        said = f"; {' and '.join(others)} {'agrees' if len(others) == 1 else 'agree'} with it" if others else ""
        return "trust", f"it passes all gates{said}"
    if row.c2st is not None and not row.c2st < NEAR[0]:
        return "do not trust", f"it passes all gates, but {_distance(row)} from {reference.label}"
    return "trust", f"it passes all gates, and is {_distance(row)} from {reference.label}"


def _verdict(row: Row, reference: Reference | None) -> tuple[Verdict, str]:
    """Of an approximation, by the reference where there is one, else by its weights."""
    weighable = row.k_hat is not None and row.k_hat < reliable(max(row.num_weighed, 2))
    weights = "" if row.k_hat is None else f"k-hat of its weights is {row.k_hat:.2g}"
    if reference is not None and row.c2st is not None:
        found = (row.c2st, row.mean_error or 0.0, row.sd_error or 0.0)
        near = all(f <= most for f, most in zip(found, NEAR, strict=True))
        said = f"{_distance(row)} from {reference.label}"
        if near:
            return "trust", said
        if weighable and not row.refined:
            return "trust after refinement", f"{said}, but {weights}: importance weights can correct it"
        return "do not trust", said
    if weighable:
        return ("trust", weights) if row.refined else ("trust after refinement", weights)
    return "do not trust", weights or "nothing exact to hold it against, and no weights that tell"


def _distance(row: Row) -> str:
    return (
        f"C2ST {row.c2st:.2f}, means within {row.mean_error:.2g} sd and sds within {100 * (row.sd_error or 0.0):.2g} %"
    )


def to_json(found: Comparison) -> dict[str, Any]:
    """All numbers, for a file or `--json`."""
    reference = found.reference and {"label": found.reference.label, "agreeing": list(found.reference.agreeing)}
    return {
        "reference": reference,
        "rows": [vars(row) | {"ess_per_second": row.ess_per_second} for row in found.rows],
    }
