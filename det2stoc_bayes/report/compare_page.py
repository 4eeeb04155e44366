"""The page that holds methods beside each other: verdicts, diagnostics, figures."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from det2stoc_bayes.compare import Comparison, Row, Run
from det2stoc_bayes.doubts import misfit
from det2stoc_bayes.psis import reliable
from det2stoc_bayes.report import compare_figures as figures
from det2stoc_bayes.report import numbers, page
from det2stoc_bayes.report.compare_figures import Posterior

BADGES = {
    "trust": "no_mismatch", "trust after refinement": "inconclusive", "do not trust": "mismatch",
    "no posterior": "inconclusive", "could not run": "mismatch",
}  # fmt: skip
COLUMNS = (
    "draws", "R-hat", "ESS", "ESS / s", "divergences", "k-hat", "C2ST", "Wasserstein [sd]", "mean [sd]", "sd [%]",
    "LOO [nat]", "compile [s]", "run [s]", "simulations", "gradients",
)  # fmt: skip
MOST_PARAMETERS = 12  # in the forest


def compare_page(found: Comparison, *, name: str, doubts: Sequence[str] = ()) -> str:
    """The report as html text; `doubts` speak against the model, whatever the method."""
    posteriors = {run.label: posterior(run) for run in found.runs}
    names = list(dict.fromkeys(n for p in posteriors.values() for n in p))
    reference = posteriors.get(found.reference.label) if found.reference else None
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
        reference=found.reference,
        verdicts=[_verdict(row, number) for number, row in enumerate(found.rows)],
        columns=COLUMNS,
        failed=found.failed,
        rows=[{"label": row.label, "values": cells(row)} for row in found.rows],
        forests=[(n, page.embedded(figures.forest_figure(posteriors, n))) for n in names[:MOST_PARAMETERS]],
        forest_height=70 + figures.ROW * len(posteriors),
        costs=[
            (title, page.embedded(figures.cost_figure(found.rows, cost, title)))
            for cost, title in (("seconds_run", "run [s]"), ("simulations", "simulations"))
        ],
        runs=drawn,
    )  # fmt: skip


def misfits(found: Comparison) -> list[str]:
    """What speaks against the model under every method, once."""
    return list(dict.fromkeys(said for run in found.runs if (said := misfit(run.tree))))[:1]


def posterior(run: Run) -> Posterior:
    """Draws (chain, draw) of every scalar of the posterior group, further dimensions as `friction[drop_03]`."""
    if "posterior" not in run.tree.children:
        return {}
    out = {}
    for name, data in run.tree["posterior"].to_dataset().data_vars.items():
        data = data.transpose("chain", "draw", ...)
        for index in np.ndindex(data.shape[2:]):
            labels = [str(data[d].values[i]) for d, i in zip(data.dims[2:], index, strict=True)]
            label = f"{name}[{', '.join(labels)}]" if labels else str(name)
            out[label] = np.asarray(data.values[(slice(None), slice(None), *index)], float)
    return out


def cells(row: Row) -> list[str]:
    """A row's numbers as text, in the order of COLUMNS."""
    percent = None if row.sd_error is None else 100 * row.sd_error
    loo = numbers.MISSING if row.elpd is None else numbers.number(row.elpd, 5)
    if row.elpd is not None and row.elpd_error is not None:
        loo = numbers.plus_minus(row.elpd, row.elpd_error)
    if row.elpd_k_hat is not None and row.elpd_k_hat > reliable(max(row.num_draws, 2)):
        loo += f" (k-hat {numbers.number(row.elpd_k_hat, 2)}: unreliable)"
    told = (row.r_hat, row.ess, row.ess_per_second, row.divergences, row.k_hat, row.c2st, row.wasserstein)
    return [
        str(row.num_draws or numbers.MISSING),
        *(_number(value) for value in (*told, row.mean_error, percent)),
        loo,
        *(_number(value) for value in (row.seconds_compile, row.seconds_run)),
        str(row.simulations),
        str(row.gradients),
    ]


def _number(value: float | None) -> str:
    return numbers.MISSING if value is None or not np.isfinite(value) else numbers.number(float(value))


def _verdict(row: Row, number: int) -> dict[str, str]:
    colour = figures.colour(number)
    return {"label": row.label, "kind": BADGES[row.verdict], "badge": row.verdict, "why": row.why, "colour": colour}


def _figures(run: Run, draws: Posterior, reference: Posterior | None, number: int) -> dict[str, Any]:
    """Ranks, traces and autocorrelation where draws come in chains; pairs in any case."""
    against = None if reference is draws else reference
    shown = {"Pairs": (figures.pair_figure(draws, against, number), 250)}
    height = 150 * min(len(draws), figures.MOST_SHOWN)
    if run.kind == "exact":
        shown["Ranks by chain"] = (figures.rank_figure(draws), height)
        shown["Traces"] = (figures.trace_figure(draws), height)
        shown["Autocorrelation"] = (figures.autocorrelation_figure(draws), height)
    embedded = [(title, page.embedded(spec), tall) for title, (spec, tall) in shown.items()]
    return {"label": run.label, "figures": embedded}
