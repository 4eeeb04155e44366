"""Compare a diagnosis (diagnosis.json) with the answer of a concealed case."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

NEUTRAL = {"ratio": 1.0}  # the value that means no effect, where it is not zero
Json = Mapping[str, Any]


@dataclass(frozen=True)
class CaseScore:
    """How one diagnosis did; None where a question does not apply.

    `named`: name and element right, equivalents included. `listed`: the right class is among an
    inconclusive diagnosis's candidates. `false_claim`: a mismatch is claimed and what is named is wrong.
    """

    truth: str
    diagnosed: str
    verdict: bool
    named: bool
    placed: bool
    listed: bool
    false_claim: bool
    covers: bool | None = None
    relative_error: float | None = None
    relative_width: float | None = None
    probability: float | None = None
    psi_covered: float | None = None


def score(answer: Json, diagnosis: Json) -> CaseScore:
    """Judge a diagnosis by the answer of its case."""
    effects, verdict = list(diagnosis.get("effects") or []), diagnosis["verdict"]
    psi = _psi_covered(answer, diagnosis)
    if not answer["effects"]:
        silent = verdict == "no_mismatch" and not effects
        said = "no_mismatch" if silent else _labels(effects, verdict)
        return CaseScore("nothing", said, silent, silent, silent, silent, not silent, psi_covered=psi)
    truth = answer["effects"][0]
    members = [truth, *truth.get("accepted", [])]
    found = [(entry, right, given) for entry in effects for right, given in _matches(members, entry)]
    placed = any(_same_element(m, given) for m in members for e in effects for given in _given(e))
    claimed = verdict == "mismatch"
    named = claimed and bool(found) and len(effects) == 1
    candidates = [*effects, *(diagnosis.get("candidates") or [])]
    result = {
        "truth": _label(truth),
        "diagnosed": _labels(effects, verdict),
        "verdict": verdict == answer["verdict"],
        "named": named,
        "placed": placed,
        "listed": any(True for entry in candidates for _ in _matches(members, entry)),
        "false_claim": claimed and not named,
        "psi_covered": psi,
    }
    if found:
        entry, right, given = found[0]
        covers, error, width = compare_parameters(right.get("parameters", {}), given.get("parameters", {}))
        result |= {"covers": covers, "relative_error": error, "relative_width": width}
        result["probability"] = entry.get("probability")
    return CaseScore(**result)


def compare_parameters(truth: Json, given: Json) -> tuple[bool | None, float | None, float | None]:
    """(all intervals cover, relative error and relative interval width of the first parameter)."""
    given = _positive_amplitude(given)
    covered: list[bool] = []
    error = width = None
    for key, value in truth.items():
        entry = given.get(key)
        if not isinstance(value, int | float) or not isinstance(entry, Mapping) or not _scalar(entry):
            continue
        if key == "timestep":  # any timestep that converges is right
            continue
        low, high = entry["interval"]
        mean = entry["mean"]
        if key in ("phase", "direction"):
            value += 2.0 * math.pi * round((mean - value) / (2.0 * math.pi))
        covered.append(low <= value <= high)
        size = abs(value - NEUTRAL.get(key, 0.0))
        if error is None and size > 0.0 and key not in ("phase", "direction"):
            error, width = abs(mean - value) / size, (high - low) / size
    return (all(covered) if covered else None), error, width


def summary(scores: Sequence[CaseScore]) -> dict[str, float | int]:
    """Counts and rates over many cases."""
    cases = [s for s in scores if s.truth != "nothing"]
    controls = [s for s in scores if s.truth == "nothing"]
    covers = [s.covers for s in cases if s.covers is not None]
    errors = sorted(s.relative_error for s in cases if s.relative_error is not None)
    return {
        "cases": len(cases),
        "verdict_right": sum(s.verdict for s in cases),
        "named_right": sum(s.named for s in cases),
        "false_claims": sum(s.false_claim for s in cases),
        "controls": len(controls),
        "false_alarms": sum(s.false_claim for s in controls),
        "intervals": len(covers),
        "intervals_cover": sum(covers),
        "median_relative_error": errors[len(errors) // 2] if errors else math.nan,
    }


def score_table(scores: Sequence[CaseScore], names: Sequence[str] | None = None) -> Table:
    """One row a case, for a terminal."""
    table = Table(title="Concealed effects and what was diagnosed")
    for heading in (
        "case",
        "concealed",
        "diagnosed",
        "right",
        "95 % covers",
        "error",
        "width",
        "psi in 95 %",
    ):
        table.add_column(heading, justify="left" if heading in ("case", "concealed", "diagnosed") else "right")
    for index, one in enumerate(scores):
        right = "yes" if one.named else "listed" if one.listed else "[red]no[/red]"
        table.add_row(
            names[index] if names else str(index + 1),
            one.truth,
            one.diagnosed,
            right,
            "" if one.covers is None else "yes" if one.covers else "[red]no[/red]",
            _percent(one.relative_error),
            _percent(one.relative_width),
            _percent(one.psi_covered),
        )
    return table


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100.0 * value:.1f} %"


def _label(entry: Json) -> str:
    return f"{entry['name']} @ {entry['element']['name']}"


def _labels(effects: Sequence[Json], verdict: str) -> str:
    return " + ".join(_label(entry) for entry in effects) or verdict


def _scalar(entry: Json) -> bool:
    return isinstance(entry.get("mean"), int | float) and len(entry.get("interval", ())) == 2


def _given(entry: Json) -> list[Json]:
    """An entry and its equivalents; an equivalent without an element acts on the entry's own."""
    return [entry, *({"element": entry["element"], **other} for other in entry.get("equivalent") or [])]


def _same_element(right: Json, given: Json) -> bool:
    a, b = right["element"], given["element"]
    if a["kind"] != b["kind"]:
        return False
    return a["kind"] in ("world", "simulator") or a["name"] in ("*", b["name"])


def _matches(members: Sequence[Json], entry: Json) -> list[tuple[Json, Json]]:
    return [(m, g) for g in _given(entry) for m in members if m["name"] == g["name"] and _same_element(m, g)]


def _positive_amplitude(given: Json) -> Json:
    """A sin(x + phase) with A < 0 is -A sin(x + phase + pi)."""
    amplitude, phase = given.get("amplitude"), given.get("phase")
    if not (amplitude and phase and _scalar(amplitude) and _scalar(phase)) or amplitude["mean"] >= 0.0:
        return given
    low, high = amplitude["interval"]
    flipped = {**amplitude, "mean": -amplitude["mean"], "interval": [-high, -low]}
    turned = {**phase, "mean": phase["mean"] + math.pi, "interval": [x + math.pi for x in phase["interval"]]}
    return {**given, "amplitude": flipped, "phase": turned}


def _psi_covered(answer: Json, diagnosis: Json) -> float | None:
    """The share of psi whose true value lies within 1.96 sds of the mean after."""
    inside = []
    for name, value in answer.get("psi", {}).items():
        after = (diagnosis.get("psi") or {}).get(name, {}).get("after")
        if after:
            inside.append(abs(after["mean"] - value) <= 1.96 * after["sd"])
    return sum(inside) / len(inside) if inside else None
