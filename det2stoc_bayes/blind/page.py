"""The proof's page: the table, intervals, probabilities, seconds, and a gallery of cases with the failures first."""

from collections.abc import Mapping, Sequence
from typing import Any

from det2stoc_bayes.blind import figures
from det2stoc_bayes.blind.score import heldout_errors, label
from det2stoc_bayes.blind.summary import HEADINGS, Row, Summary, cells, sentences
from det2stoc_bayes.report import numbers, page

MOST_SHOWN = 120  # cases in the gallery
LEVEL = 0.01  # of the tests

Json = Mapping[str, Any]


def proof_page(lines: Sequence[Json], rows: Sequence[Row], told: Summary) -> str:
    """The report as html text, from the log's lines and their scores."""
    order = sorted(range(len(rows)), key=lambda i: rows[i].score.named)  # stable: misses first
    shown = order[: max(MOST_SHOWN, sum(not r.score.named for r in rows))]
    return page.render(
        "blind.html.j2",
        title="Concealed effects",
        verdict="mismatch",
        badge=_badge(told),
        headline=headline(told),
        headings=HEADINGS,
        kinds=[(tally.name, cells(tally)) for tally in told.kinds],
        systems=[(tally.name, cells(tally)) for tally in told.systems],
        coverage=[
            (c.name, c.inside, c.count, numbers.percent(c.inside / c.count, 1), numbers.number(c.p_value, 2))
            for c in told.coverage
            if c.count
        ],
        reliability=told.reliability,
        reliability_figure=told.reliability and page.embedded(figures.reliability_figure(told.reliability)),
        pooled=sentences(told),
        seconds_figure=page.embedded(figures.seconds_figure(rows)),
        seconds_height=90 + 26 * len(told.systems),
        cases=[_case(lines[i], rows[i]) for i in shown],
        left_out=len(rows) - len(shown),
        runs=_runs(lines),
    )


def headline(told: Summary) -> str:
    """One sentence."""
    silent = [t for t in told.kinds[:-1] if "control" in t.name]
    found = [t for t in told.kinds[:-1] if "control" not in t.name]
    parts = []
    if found:
        right, of = sum(t.right for t in found), sum(t.cases for t in found)
        parts.append(f"in {right} of {of} studies all that was concealed was named at the right place")
    if silent:
        alarms, of = sum(t.false_claims for t in silent), sum(t.cases for t in silent)
        parts.append(f"{alarms} false alarm{'' if alarms == 1 else 's'} in {of} with nothing concealed")
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def _badge(told: Summary) -> tuple[str, str]:
    """Its class and its text: whether a test rejects what was stated."""
    tests = {"intervals": [c.p_value for c in told.coverage if c.name == "both" and c.count]}
    tests["stated probabilities"] = [told.reliability.p_value] if told.reliability else []
    rejected = [name for name, p in tests.items() if any(v < LEVEL for v in p)]
    if rejected:
        return "mismatch", f"{' and '.join(rejected)} rejected at {LEVEL:.0%}".capitalize()
    tested = [name for name, p in tests.items() if p]
    if not tested:
        return "inconclusive", "Nothing to test"
    return "no_mismatch", f"{' and '.join(tested)} hold".capitalize()


def _runs(lines: Sequence[Json]) -> list[str]:
    """Seeds and commits, in the order of the log."""
    keys = dict.fromkeys((line.get("seed", ""), line.get("commit", "")[:7]) for line in lines)
    return [f"seed {seed}" + (f", commit {commit}" if commit else "") for seed, commit in keys]


def _case(line: Json, row: Row) -> dict[str, Any]:
    """A case of the gallery."""
    answer, diagnosis = line["answer"], line["diagnosis"]
    before, after = heldout_errors(answer, diagnosis.get("fit"))
    rollout = line.get("rollout")
    claims = diagnosis.get("effects") or []
    said = diagnosis.get("summary") or " ".join(e.get("statement", label(e)) for e in claims)
    return {
        "name": f"{line['kind']} {line['index']}",
        "seed": line.get("case_seed", ""),
        "right": row.score.named,
        "system": ", ".join([row.system, *answer.get("variants", [])]),
        "truth": row.score.truth,
        "said": row.score.diagnosed,
        "statement": said or diagnosis.get("error", "")[-300:],
        "candidates": [
            (label(c) if c.get("element") else c["name"], numbers.percent(c["probability"], 1))
            for c in (diagnosis.get("candidates") or [])[:5]
        ],
        "sizes": [size for truth in answer["effects"] for size in _sizes(truth, claims)],
        "error": before and f"{numbers.number(before)} → {numbers.number(after)}",
        "improvement": row.score.improvement is not None and numbers.percent(row.score.improvement, 1),
        "seconds": numbers.duration(line["seconds"]),
        "rollout": rollout and page.embedded(figures.rollout_figure(rollout)),
        "channel": rollout and f"{rollout['channel']} of {rollout['recording']}",
    }


def _sizes(truth: Json, claims: Sequence[Json]) -> list[tuple[str, str, str, str]]:
    """Parameter, truth, and what a claim of the same name gives for it."""
    given = next((c["parameters"] for c in claims if c["name"] == truth["name"]), {})
    found = []
    for key, value in truth.get("parameters", {}).items():
        estimate = given.get(key) if isinstance(given.get(key), Mapping) else {}
        found.append((f"{truth['name']}: {key}", _value(value), _value((estimate or {}).get("mean")), ""))
        if estimate and estimate.get("interval"):
            found[-1] = (*found[-1][:3], _value(estimate["interval"]))
    return found


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_value(v) for v in value)}]"
    if isinstance(value, int | float) or value is None:
        return numbers.number(value, 4)
    return str(value)
