"""A finding as it is printed: what is left out with how much, the doubtful candidates, and psi before and after."""

from typing import Any

from rich.console import RenderableType
from rich.markup import escape
from rich.text import Text

from det2stoc_bayes.mismatch.finding import Curve, Finding
from det2stoc_bayes.tables import MISSING, number, stack, table


def finding_tables(finding: Finding) -> RenderableType:
    """All of it, one table below the other; a table without rows is not shown."""
    found = table("effects", "effect", "on", "parameter", "mean>", "95 % interval", "unit", "probability>")
    for effect in finding.effects:
        head = (effect.name, effect.element.label)
        for name, value in effect.parameters.items():
            mean = _span(value) if isinstance(value, Curve) else _plain(getattr(value, "mean", value))
            interval, unit = _plain(getattr(value, "interval", None), " to "), getattr(value, "unit", "")
            cells = (name, mean, interval, unit, number(effect.probability, 3))
            found.add_row(*(escape(cell) for cell in (*head, *cells)))
            head = ("", "")
    candidates = table("candidates", "effect", "on", "probability>")
    for c in finding.candidates:
        on = "" if c.element is None else c.element.label
        candidates.add_row(c.name, escape(on), number(c.probability, 3))
    hangs = any(change.over_equivalents for change in finding.psi.values())
    psi = table("psi", "name", "before>", "after>", *(["95 % over equivalents"] if hangs else []))
    for name, change in finding.psi.items():
        sides = [f"{_plain(m.mean)} +- {_plain(m.sd)}" for m in (change.before, change.after)]
        psi.add_row(*map(escape, [name, *sides, *([_plain(change.over_equivalents or "", " to ")] if hangs else [])]))
    parts: list[RenderableType] = [Text(f"{finding.verdict}: {finding.summary}", style="bold")]
    parts += [t for t in (found, candidates, psi) if t.row_count]
    if finding.experiment is not None:
        parts.append(Text(finding.experiment.text))
    return stack(parts)


def _plain(value: Any, between: str = ", ") -> str:
    """Numbers, or vectors of them, in short; `between`: within the innermost, as the bounds of an interval."""
    if isinstance(value, list | tuple):
        outer = any(isinstance(v, list | tuple) for v in value)
        return (", " if outer else between).join(_plain(v, between) for v in value)
    return number(value) if isinstance(value, int | float) else MISSING if value is None else str(value)


def _span(curve: Curve) -> str:
    """The least and the largest of a curve's values; all of them are in diagnosis.json."""
    known = [y for y in curve.y if y is not None]
    return f"{number(min(known))} to {number(max(known))}" if known else MISSING
