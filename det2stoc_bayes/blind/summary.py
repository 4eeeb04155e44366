"""Many scored cases as counts: by kind and by system, pooled intervals and probabilities, and as Markdown."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from scipy import stats

from det2stoc_bayes.blind.score import CaseScore, score
from det2stoc_bayes.blind.statements import Group, Reliability, groups, reliability

LEVEL = 0.95  # of the intervals


@dataclass(frozen=True)
class Row:
    """A case: its kind and system, its score, what it took, and what it stated."""

    kind: str
    system: str
    score: CaseScore
    seconds: float
    megabytes: float
    stated: tuple[Group, ...] = ()


@dataclass(frozen=True)
class Tally:
    """Some cases counted. `right`: name and element of all effects and nothing else, or silence; NaN: none to count.

    Errors and widths are medians, relative to the size; `improvement` is a median, too.
    """

    name: str
    cases: int
    right: int
    verdict: int
    false_claims: int
    intervals: int
    cover: int
    narrow: int
    error: float
    width: float
    improvement: float
    seconds: float
    longest: float
    megabytes: float


@dataclass(frozen=True)
class Coverage:
    """How many intervals of a sort hold the truth, and the exact binomial p-value that 95 % of such ones do."""

    name: str
    count: int
    inside: int
    p_value: float


@dataclass(frozen=True)
class Summary:
    """All figures of a proof."""

    kinds: tuple[Tally, ...]
    systems: tuple[Tally, ...]
    coverage: tuple[Coverage, ...]
    reliability: Reliability | None

    @property
    def whole(self) -> Tally:
        """All cases."""
        return self.kinds[-1]

    def to_json(self) -> dict[str, Any]:
        """All numbers."""
        return asdict(self)


def row(line: Mapping[str, Any]) -> Row:
    """A line of the log, scored anew."""
    answer, diagnosis = line["answer"], line["diagnosis"]
    stated = tuple(groups(answer, diagnosis))
    system = answer.get("system", "")
    return Row(line["kind"], system, score(answer, diagnosis), line["seconds"], line["peak_mb"], stated)


def summarize(rows: Sequence[Row]) -> Summary:
    """The figures of at least one case."""
    return Summary(
        (*_tallies(rows, lambda r: r.kind), _tally("all", rows)),
        _tallies(rows, lambda r: r.system),
        pooled(rows),
        reliability([group for r in rows for group in r.stated]),
    )


def pooled(rows: Iterable[Row]) -> tuple[Coverage, ...]:
    """Intervals of every parameter by itself, a vector as one.

    Those of effects that were named, those of psi where all was told by its own name, both together, and the other psi.
    """
    effects, psi, alike, others = [], [], [], []
    for r in rows:
        effects += [inside for e in r.score.effects for inside in e.estimates.inside]
        (psi if r.score.own else alike if r.score.named else others).extend(r.score.psi_inside)
    named = {"effects": effects, "psi": psi, "both": [*effects, *psi]}
    named |= {"psi where an equivalent was said": alike, "psi where something else was said": others}
    return tuple(
        Coverage(name, len(v), sum(v), float(stats.binomtest(sum(v), len(v), LEVEL).pvalue) if v else math.nan)
        for name, v in named.items()
    )


def _tallies(rows: Sequence[Row], key: Callable[[Row], str]) -> tuple[Tally, ...]:
    return tuple(_tally(name, [r for r in rows if key(r) == name]) for name in dict.fromkeys(map(key, rows)))


def _tally(name: str, rows: Sequence[Row]) -> Tally:
    scores = [r.score for r in rows]
    estimates = [e.estimates for s in scores for e in s.effects if e.estimates.covers is not None]
    return Tally(
        name,
        len(rows),
        sum(s.named for s in scores),
        sum(s.verdict for s in scores),
        sum(s.false_claim for s in scores),
        len(estimates),
        sum(bool(e.covers) for e in estimates),
        sum(bool(e.narrow) for e in estimates),
        _median(e.error for e in estimates),
        _median(e.width for e in estimates),
        _median(s.improvement for s in scores),
        _median(r.seconds for r in rows),
        max((r.seconds for r in rows), default=math.nan),
        max((r.megabytes for r in rows), default=math.nan),
    )


HEADINGS = (
    "cases", "right", "verdict", "false claims", "covered", "narrow", "error", "width", "improvement", "s",
    "longest", "peak MB",
)  # fmt: skip


def cells(tally: Tally) -> list[str]:
    """A tally as text, in the order of HEADINGS."""
    of = f" of {tally.intervals}"
    counts = [tally.cases, tally.right, tally.verdict, tally.false_claims, f"{tally.cover}{of}", f"{tally.narrow}{of}"]
    shares = [_percent(v) for v in (tally.error, tally.width, tally.improvement)]
    took = [f"{v:.0f}" for v in (tally.seconds, tally.longest, tally.megabytes)]
    return [str(c) for c in counts] + shares + took


def missed(rows: Sequence[Row]) -> list[str]:
    """What was not right, and what was said instead."""
    wrong = [r for r in rows if not r.score.named]
    return [f"{r.kind}: {r.score.truth} was said to be {r.score.diagnosed}{_remark(r.score)}" for r in wrong]


def sentences(told: Summary) -> list[str]:
    """What is pooled, in words."""
    lines = [
        f"95 % intervals, {c.name}: {c.inside} of {c.count} hold the truth (p = {c.p_value:.2g})"
        for c in told.coverage
        if c.count
    ]
    r = told.reliability
    if r is not None:
        lines.append(
            f"{r.num_statements} stated probabilities (p = {r.p_value:.2g} if they are right): log score "
            f"{r.log_score:.3f} nat a finding, {r.expected:.3f} if they are right; Brier score {r.brier:.4f}"
        )
    return lines


def _remark(one: CaseScore) -> str:
    if one.truth == "nothing":
        return " (false alarm)"
    return " (among the candidates)" if one.listed else " (element right)" if one.placed else ""


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{100.0 * value:.1f} %"


def _median(values: Iterable[float | None]) -> float:
    told = [v for v in values if v is not None]
    return median(told) if told else math.nan
