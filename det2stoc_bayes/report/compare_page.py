"""The page that holds methods beside each other: verdicts, diagnostics, figures."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from det2stoc_bayes.comparison import Comparison, Row, Run
from det2stoc_bayes.doubts import misfit, surprising
from det2stoc_bayes.psis import reliable
from det2stoc_bayes.report import compare_figures as figures
from det2stoc_bayes.report import numbers, page
from det2stoc_bayes.report.canvas import Spec
from det2stoc_bayes.report.compare_figures import Posterior
from det2stoc_bayes.report.summary import scalars
from det2stoc_bayes.run_statistics import energies

BADGES = {
    "trust": "no_mismatch", "trust after refinement": "inconclusive", "do not trust": "mismatch",
    "no posterior": "inconclusive",
}  # fmt: skip
MOST_PARAMETERS = 12  # in the forest


def compare_page(found: Comparison, *, name: str, doubts: Sequence[str] = ()) -> str:
    """The report as html text; `doubts` speak against the model, whatever the method."""
    posteriors = {run.label: _posterior(run) for run in found.runs}
    names = list(dict.fromkeys(n for p in posteriors.values() for n in p))
    held, shown = found.reference, dict(posteriors)
    if held is not None and held.named is not None:
        shown[held.label] = {name: draws[None] for name, draws in held.named.items()}
    reference = None if held is None else shown.get(held.label)
    numbered = [(k, run) for k, run in enumerate(found.runs) if run.draws is not None]
    drawn = [_figures(run, posteriors[run.label], reference, k) for k, run in numbered]
    trusted = [row.label for row in found.rows if row.verdict == "trust"]
    return page.render(
        "compare.html.j2",
        title=f"{name}: methods compared",
        verdict="mismatch",  # whose page has two colours
        name=name,
        trusted=trusted,
        doubts=doubts,
        reference=held,
        verdicts=[_verdict(row, number) for number, row in enumerate(found.rows)],
        failed=found.failed,
        tables=[
            (title, list(columns), [(row.label, [told(row) for told in columns.values()]) for row in found.rows])
            for title, columns in TABLES.items()
            if held is not None or title != DISTANCES
        ],
        forests=[_drawn(n, figures.forest_figure(shown, n)) for n in names[:MOST_PARAMETERS]],
        costs=[
            _drawn(title, figures.cost_figure(found.rows, cost, title))
            for cost, title in (("seconds_run", "run [s]"), ("simulations", "simulations"))
            if any(getattr(row, cost) for row in found.rows)
        ],
        runs=drawn,
    )  # fmt: skip


def misfits(found: Comparison) -> list[str]:
    """What speaks against the model: its misfit, the same under every method, and each amortized method's surprise."""
    every = [said for run in found.runs if (said := misfit(run.tree))][:1]
    return [*every, *(f"{run.label}: {said}" for run in found.runs if (said := surprising(run.tree)))]


def _posterior(run: Run) -> Posterior:
    return {label: draws for _, label, draws in scalars(run.tree)}


def _number(value: float | None) -> str:
    return numbers.MISSING if value is None or not np.isfinite(value) else numbers.number(float(value))


def _loo(row: Row) -> str:
    if row.elpd is None:
        return numbers.MISSING
    said = numbers.number(row.elpd, 5) if row.elpd_error is None else numbers.plus_minus(row.elpd, row.elpd_error)
    if row.elpd_k_hat is not None and row.elpd_k_hat > reliable(max(row.num_draws, 2)):
        return f"{said} (k-hat {numbers.number(row.elpd_k_hat, 2)}: unreliable)"
    return said


def _of(name: str, times: float = 1.0) -> Callable[[Row], str]:
    def told(row: Row) -> str:
        value = getattr(row, name)
        return _number(None if value is None else times * value)

    return told


DISTANCES = "Distance from the reference"
TABLES: dict[str, dict[str, Callable[[Row], str]]] = {
    "Draws": {
        "draws": lambda row: str(row.num_draws or numbers.MISSING),
        "R-hat": _of("r_hat"),
        "ESS": _of("ess"),
        "divergences": _of("divergences"),
        "BFMI": _of("bfmi"),
        "k-hat": _of("k_hat"),
    },
    DISTANCES: {
        "C2ST": _of("c2st"),
        "Wasserstein [sd]": _of("wasserstein"),
        "KL [nat]": _of("kl"),
        "mean [sd]": _of("mean_error"),
        "sd [%]": _of("sd_error", 100.0),
    },
    "Recordings under the posterior": {
        "predictive p": _of("predictive_p"),
        "surprise p": _of("surprise_p"),
        "LOO [nat]": _loo,
    },
    "Cost": {
        "run [s]": _of("seconds_run"),
        "ESS / s": _of("ess_per_second"),
        "compile [s]": _of("seconds_compile"),
        "simulations": lambda row: str(row.simulations),
        "gradients": lambda row: str(row.gradients),
    },
}


def _verdict(row: Row, number: int) -> dict[str, str]:
    colour = figures.colour(number)
    return {"label": row.label, "kind": BADGES[row.verdict], "badge": row.verdict, "why": row.why, "colour": colour}


def _figures(run: Run, draws: Posterior, reference: Posterior | None, number: int) -> dict[str, Any]:
    """Ranks, traces and autocorrelation where draws come in chains; pairs in any case."""
    against = None if reference is draws else reference
    shown = {"Pairs": figures.pair_figure(draws, against, number)}
    if run.kind == "exact":
        shown["Ranks by chain"] = figures.rank_figure(draws)
        shown["Traces"] = figures.trace_figure(draws)
        shown["Autocorrelation"] = figures.autocorrelation_figure(draws)
    if (energy := energies(run.tree)) is not None and energy.shape[1] > 1:
        shown["Energy"] = figures.energy_figure(energy)
    return {"label": run.label, "figures": [_drawn(title, spec) for title, spec in shown.items()]}


def _drawn(title: str, spec: Spec) -> tuple[str, str, int]:
    """Title, figure for the page, and its height."""
    return title, page.embedded(spec), spec["layout"]["height"]
