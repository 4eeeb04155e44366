"""What the commands print on stdout: results as tables, and the same results as plain mappings for --json."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    # Dotted names, so that the checker of the tests can look them up.
    import det2stoc_bayes.calibration
    import det2stoc_bayes.comparison
    import det2stoc_bayes.identifiability
    import det2stoc_bayes.mismatch.effects.base
    import det2stoc_bayes.report.summary
    import det2stoc_bayes.study

COLOUR = {"identifiable": "green", "weak": "yellow", "not identifiable": "red"}
MISSING = "-"


def number(value: float | None, digits: int = 4) -> str:
    """`0.3121`, or `-` where there is none."""
    return MISSING if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def table(title: str, *headings: str) -> Table:
    """A plain table; a heading that ends in `>` is of numbers."""
    made = Table(title=title, title_justify="left", title_style="bold", header_style="bold", box=None, pad_edge=False)
    for heading in headings:
        made.add_column(escape(heading.rstrip(">")), justify="right" if heading.endswith(">") else "left")
    return made


def prior_text(parameter: "det2stoc_bayes.study.Parameter") -> str:
    """As `Normal(loc=1, scale=0.2)`."""
    prior = parameter.prior
    return f"{prior.family}({', '.join(f'{k}={v:g}' for k, v in prior.arguments.items())})"


def target_text(parameter: "det2stoc_bayes.study.Parameter") -> str:
    """As `pair/floor_box/friction[0, 1]`."""
    index = "" if parameter.index is None else f"[{', '.join(map(str, parameter.index))}]"
    return f"{parameter.target}{index}"


# --- check ------------------------------------------------------------
def check_json(checked: "det2stoc_bayes.identifiability.Check") -> dict[str, Any]:
    """All of a check."""
    psi = [
        {
            "name": p.name, "target": str(p.target), "index": p.index, "varies": p.varies,
            "prior": {p.prior.family: dict(p.prior.arguments)}, "mean": c.mean, "sd": c.sd,
            "sd_ratio": c.sd_ratio, "verdict": c.verdict, "entangled": c.entangled,
        }
        for p, c in zip(checked.study.parameters, checked.parameters, strict=True)
    ]  # fmt: skip
    return {
        "study": checked.study.name,
        "psi": psi,
        "recordings": [vars(r) for r in checked.recordings],
        "columns": [vars(c) for c in checked.columns],
        "noise_inflation": checked.noise_inflation,
        "open_equivalences": checked.alike,
        "absorbed_by_psi": checked.absorbed,
        "contact": checked.contact,
        "free_flight": [{**vars(f), "contradicts": f.contradicts} for f in checked.falls],
    }


def check_tables(checked: "det2stoc_bayes.identifiability.Check") -> RenderableType:
    """All of a check: psi, recordings, columns, and in words what cannot be told apart."""
    from det2stoc_bayes.doubts import quick_misfit

    psi = table("psi", "name", "sets", "prior", "varies", "mean>", "sd>", "sd / prior sd>", "")
    for p, c in zip(checked.study.parameters, checked.parameters, strict=True):
        psi.add_row(
            p.name, escape(target_text(p)), prior_text(p), p.varies, number(c.mean), number(c.sd, 2),
            number(c.sd_ratio, 2), f"[{COLOUR[c.verdict]}]{c.verdict}",
        )  # fmt: skip
    recordings = table("recordings", "name", "role", "samples>", "seconds>", "columns>", "misfit unfitted / noise sd>")
    for r in checked.recordings:
        misfit = "diverges" if r.misfit == math.inf else number(r.misfit, 3)
        recordings.add_row(escape(r.name), r.role, str(r.samples), number(r.seconds), str(len(r.columns)), misfit)
    columns = table("columns", "name", "noise sd>", "")
    for c in checked.columns:
        columns.add_row(escape(c.name), number(c.noise, 3), "given" if c.given else "estimated")
    pairs = {tuple(sorted((p.name, other))) for p in checked.parameters for other in p.entangled}
    notes = [f"{a} and {b} are found together only: one can be traded for the other." for a, b in sorted(pairs)]
    if not checked.parameters:
        notes.append("The study has no psi: nothing of the model is uncertain.")
    notes += [doubt] if (doubt := quick_misfit(checked)) else []
    notes += [*(f.text for f in checked.falls if f.contradicts), *_open(checked)]
    return stack([*([psi] if checked.parameters else []), recordings, columns, *(Text(n) for n in notes)])


def _open(checked: "det2stoc_bayes.identifiability.Check") -> list[str]:
    """Which effects, were they missing from the model, would stay open."""
    told = []
    if checked.contact:
        return ["Bodies touch: simulations were led along the recordings, and effects were not compared."]
    if checked.alike:
        head = "Were one of these missing from the model, these recordings could not say which of its line:"
        told.append("\n".join([head, *(f"- {', '.join(group)}" for group in checked.alike)]))
    if checked.absorbed:
        told.append(f"Missing effects that a wrong psi would hide completely: {', '.join(checked.absorbed)}.")
    return ["No effect has been looked for yet. " + told[0], *told[1:]] if told else []


# --- fit ------------------------------------------------------------
def fit_json(
    rows: Sequence["det2stoc_bayes.report.summary.Row"],
    told: Sequence["det2stoc_bayes.report.summary.Told"],
    attributes: Mapping[Any, Any],
    path: str,
) -> dict[str, Any]:
    """A fit's summary, and where the whole of it is."""
    kept = ("method", "engine", "seed", "seconds_run", "simulations", "noise_inflation", "k_hat", "effective_draws")
    about = {k: attributes[k] for k in kept if k in attributes}
    found = about | {"file": path, "parameters": [vars(r) for r in rows]}
    return found | ({"predictions": [vars(t) for t in told]} if told else {})


def fit_tables(
    rows: Sequence["det2stoc_bayes.report.summary.Row"],
    told: Sequence["det2stoc_bayes.report.summary.Told"],
    title: str,
) -> RenderableType:
    """A fit's summary, and how it tells held-out recordings where it is a stochastic simulator's."""
    made = table(title, "name", "mean>", "sd>", "95 % interval", "R-hat>", "ESS>")
    for r in rows:
        low, high = r.interval
        r_hat = MISSING if r.r_hat is None else f"{r.r_hat:.3f}"
        ess = MISSING if r.ess is None else f"{r.ess:.0f}"
        made.add_row(escape(r.name), number(r.mean), number(r.sd, 2), f"{number(low)} to {number(high)}", r_hat, ess)
    ways = ("matched Gaussian>", "mixture>", "one z>")
    head = "held-out log density [nat a transition]"
    heldout = table(head if rows else f"{title}: {head}", "recording", "transitions>", *ways)
    for t in told:
        values = (number(v) for v in (t.matched, t.mixture, t.one_latent))
        heldout.add_row(escape(t.recording), str(t.num_transitions), *values)
    return stack([*([made] if rows else []), *([heldout] if told else [])])


# --- reproduce --------------------------------------------------------
def experiment_table(result: Mapping[str, Any]) -> RenderableType:
    """The figures that an experiment's results give as their table, and those of populations where it infers any."""
    made = []
    for shown in filter(None, (result["table"], result.get("populations"))):
        made.append(table(shown["title"], *shown["columns"]))
        for row in shown["rows"]:
            cells = (MISSING if cell is None else cell if isinstance(cell, str) else number(cell) for cell in row)
            made[-1].add_row(*cells)
    return Group(*made)


# --- compare ------------------------------------------------------------
VERDICTS = {"trust": "green", "trust after refinement": "yellow", "do not trust": "red", "no posterior": "yellow"}


def compare_json(found: "det2stoc_bayes.comparison.Comparison") -> dict[str, Any]:
    """All numbers."""
    held = found.reference
    reference = held and {"label": held.label, "agreeing": held.agreeing, "contradicting": held.contradicting}
    return {
        "reference": reference,
        "failed": dict(found.failed),
        "rows": [vars(row) | {"ess_per_second": row.ess_per_second} for row in found.rows],
    }


def compare_table(found: "det2stoc_bayes.comparison.Comparison", name: str) -> RenderableType:
    """A line a method: what its draws are worth, how far they are from the reference, what they took, a verdict."""
    against = f"against {found.reference.label}" if found.reference else "no exact run that passes its gates"
    headings = (
        "method",
        "R-hat>",
        "ESS>",
        "k-hat>",
        "C2ST>",
        "mean [sd]>",
        "sd [%]>",
        "run [s]>",
        "simulations>",
        "",
        "",
    )
    made = table(f"{name}: methods compared, {against}", *headings)
    for row in found.rows:
        percent = None if row.sd_error is None else 100 * row.sd_error
        told = (row.ess, row.k_hat, row.c2st, row.mean_error, percent, row.seconds_run)
        verdict = f"[{VERDICTS[row.verdict]}]{row.verdict}"
        cells = (number(row.r_hat, 4), *(number(v, 3) for v in told), str(row.simulations))
        made.add_row(row.label, *cells, verdict, escape(row.why))
    for label, why in found.failed.items():
        made.add_row(label, *[MISSING] * 8, "[red]could not run", escape(why))
    return made


# --- calibrate ------------------------------------------------------------
def calibration_tables(found: "det2stoc_bayes.calibration.Calibration") -> RenderableType:
    """A line an unknown, one for all together, and the verdict in a sentence."""
    headings = ("unknown", "p chi-squared>", "p uniform>", "mean rank>", "rank spread>", "sd / prior sd>", "")
    made = table(f"{found.problem}: {found.method}, {len(found.ranks)} replications", *headings)
    for u in found.unknowns:
        told = (number(v, 3) for v in (u.p_chi2, u.p_uniform, u.mean, u.spread, u.sd))
        made.add_row(escape(u.name), *told, f"[red]{u.shape}" if u.rejected else "[green]even")
    made.add_row("all together (TARP)", MISSING, number(found.p_tarp, 3), *[MISSING] * 3, "")
    notes = []
    if found.failed:
        notes.append(f"{len(found.failed)} replications could not be fitted; the first: {found.failed[0]}")
    notes += [found.shortage] if found.shortage else []
    return stack([made, *(Text(n) for n in notes), Text(found.verdict, style="bold")])


# --- effects ------------------------------------------------------------
def effects_json(
    catalogue: Mapping[str, "det2stoc_bayes.mismatch.effects.base.Effect"],
) -> list[dict[str, Any]]:
    """The catalogue; a unit has two forms where it is that of a slide joint or of a hinge."""
    return [
        {
            "name": e.name,
            "element": e.kind,
            "law": e.law_text,
            "latex": e.law,
            "parameters": [{"name": p.name, "unit": p.unit, "size": p.size} for p in e.parameters],
            "description": (type(e).__doc__ or "").strip().splitlines()[0],
        }
        for e in _forms(catalogue)
    ]


def _forms(
    catalogue: Mapping[str, "det2stoc_bayes.mismatch.effects.base.Effect"],
) -> "list[det2stoc_bayes.mismatch.effects.base.Effect]":
    """Forms that differ in what is shown: those of a contact on geoms and on a listed pair are one."""
    forms: dict[tuple[str, str, str], det2stoc_bayes.mismatch.effects.base.Effect] = {}
    for e in (form for effect in catalogue.values() for form in effect.forms()):
        forms.setdefault((e.name, e.kind, e.law_text), e)
    return list(forms.values())


def effects_table(catalogue: Mapping[str, "det2stoc_bayes.mismatch.effects.base.Effect"]) -> RenderableType:
    """The catalogue."""
    made = table("effects", "name", "on a", "law", "parameters")
    for e in _forms(catalogue):
        units = (" or ".join([p.unit] if isinstance(p.unit, str) else p.unit) for p in e.parameters)
        sizes = ("" if p.size == 1 else f" x {p.size}" for p in e.parameters)
        named = (f"{p.name} [{unit}]{size}" for p, unit, size in zip(e.parameters, units, sizes, strict=True))
        made.add_row(e.name, e.kind, escape(e.law_text), escape(", ".join(named)))
    return made


def stack(parts: Sequence[RenderableType]) -> RenderableType:
    """One below the other, a blank line between."""
    spaced: list[RenderableType] = []
    for part in parts:
        spaced += [part, ""]
    return Group(*spaced[:-1])
