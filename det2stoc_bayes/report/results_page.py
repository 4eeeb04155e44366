"""The pages over a folder of results: a list that filters, and two runs side by side."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

from det2stoc_bayes.report import numbers, page
from det2stoc_bayes.report.result_facts import Fact
from det2stoc_bayes.report.results import Result

BADGES = {
    "mismatch": "mismatch", "not trusted": "mismatch", "not calibrated": "mismatch", "unreadable": "mismatch",
    "no_mismatch": "no_mismatch", "trusted": "no_mismatch", "calibrated": "no_mismatch",
    "inconclusive": "inconclusive", "model in doubt": "inconclusive",
}  # fmt: skip


def list_page(found: Sequence[Result], folder: str) -> str:
    """The list as html text, from results below `folder`."""
    return page.render(
        "results.html.j2",
        title=f"{folder}: results",
        verdict="mismatch",
        folder=folder,
        results=[_listed(result) for result in found],
        kinds=sorted({result.kind for result in found}),
    )


def beside_page(first: Result, second: Result) -> str:
    """Two runs side by side as html text; rows that differ are marked."""
    return page.render(
        "beside.html.j2",
        title=f"{first.folder} beside {second.folder}",
        verdict="mismatch",
        runs=[_listed(first), _listed(second)],
        sections=[(title, rows) for title, rows in _aligned(first, second)],
        same_kind=first.kind == second.kind,
    )


def _listed(result: Result) -> dict[str, Any]:
    return {
        "folder": result.folder,
        "kind": result.kind,
        "name": result.name,
        "verdict": result.verdict.replace("_", " "),
        "badge": BADGES.get(result.verdict, ""),
        "headline": result.headline,
        "written": datetime.fromtimestamp(result.written, UTC).strftime("%Y-%m-%d %H:%M"),
        "report": result.report and f"/files/{quote(result.report)}",
        "files": [(name, f"/files/{quote(result.at(name))}") for name in result.files],
    }


def _aligned(first: Result, second: Result) -> list[tuple[str, list[dict[str, Any]]]]:
    """Sections and their rows in the order of the first run; what only the second has comes after."""
    one, other = ({title: {f.label: f for f in facts} for title, facts in r.facts} for r in (first, second))
    sections = []
    for title in dict.fromkeys((*one, *other)):
        left, right = one.get(title, {}), other.get(title, {})
        rows = [_row(label, left.get(label), right.get(label)) for label in dict.fromkeys((*left, *right))]
        sections.append((title, rows))
    return sections


def _row(label: str, left: Fact | None, right: Fact | None) -> dict[str, Any]:
    texts = [fact.text if fact else numbers.MISSING for fact in (left, right)]
    return {"label": label, "texts": texts, "differs": texts[0] != texts[1], "bars": _bars(left, right)}


def _bars(left: Fact | None, right: Fact | None) -> list[tuple[float, float, float]] | None:
    """Left edge, width and middle of both intervals, in percent of what they cover together."""
    if not (left and right and left.interval and right.interval):
        return None
    low, high = min(left.interval[0], right.interval[0]), max(left.interval[2], right.interval[2])
    if not high > low:
        return None
    scaled = [
        [100 * (value - low) / (high - low) for value in fact.interval] for fact in (left, right) if fact.interval
    ]
    return [(a, max(c - a, 0.5), b) for a, b, c in scaled]
