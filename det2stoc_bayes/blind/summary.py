"""Many scored cases as counts and as Markdown."""

import math
from collections.abc import Sequence
from statistics import median

from det2stoc_bayes.blind.score import CaseScore

Row = tuple[str, CaseScore, float, float]  # kind of case, its score, seconds, peak memory [MB]


def summary(scores: Sequence[CaseScore]) -> dict[str, float | int]:
    """Counts and rates over many cases."""
    cases = [s for s in scores if s.truth != "nothing"]
    controls = [s for s in scores if s.truth == "nothing"]
    estimates = [e.estimates for s in cases for e in s.effects if e.estimates.covers is not None]
    errors = [e.error for e in estimates if e.error is not None]
    widths = [e.width for e in estimates if e.width is not None]
    return {
        "cases": len(cases),
        "verdict_right": sum(s.verdict for s in cases),
        "named_right": sum(s.named for s in cases),
        "false_claims": sum(s.false_claim for s in cases),
        "controls": len(controls),
        "false_alarms": sum(s.false_claim for s in controls),
        "intervals": len(estimates),
        "intervals_cover": sum(bool(e.covers) for e in estimates),
        "intervals_narrow": sum(bool(e.narrow) for e in estimates),
        "median_relative_error": median(errors) if errors else math.nan,
        "median_relative_width": median(widths) if widths else math.nan,
        "psi_covered": _mean([s.psi_covered for s in scores]),
        "psi_narrow": _mean([s.psi_narrow for s in scores]),
    }


def markdown(rows: Sequence[Row]) -> str:
    """The score by kind of case, then misses with what was said, and false alarms."""
    head = ("kind", "cases", "right", "verdict", "false claims", "cover", "narrow", "error", "width")
    head = (*head, "psi cover", "psi narrow", "s", "peak MB")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for kind in (*dict.fromkeys(kind for kind, *_ in rows), "all"):
        mine = [row for row in rows if kind in ("all", row[0])]
        if not mine:
            continue
        scores = [s for _, s, _, _ in mine]
        count = summary(scores)
        told, claims = count["intervals"], count["false_claims"] + count["false_alarms"]
        cells = [kind, len(mine), sum(s.named for s in scores), sum(s.verdict for s in scores), claims]
        cells += [f"{count['intervals_cover']} of {told}", f"{count['intervals_narrow']} of {told}"]
        cells += [_percent(count[key]) for key in ("median_relative_error", "median_relative_width")]
        cells += [_percent(count[key]) for key in ("psi_covered", "psi_narrow")]
        cells += [f"{median(s for *_, s, _ in mine):.0f}", f"{max(mb for *_, mb in mine):.0f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    missed = [(k, s) for k, s, *_ in rows if not s.named]
    if missed:
        lines += ["", "Not right:", ""]
        lines += [f"- {k}: {s.truth} was said to be {s.diagnosed}{_remark(s)}" for k, s in missed]
    return "\n".join(lines)


def _remark(one: CaseScore) -> str:
    if one.truth == "nothing":
        return " (false alarm)"
    return " (among the candidates)" if one.listed else " (element right)" if one.placed else ""


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{100.0 * value:.1f} %"


def _mean(values: Sequence[float | None]) -> float:
    told = [v for v in values if v is not None]
    return sum(told) / len(told) if told else math.nan
