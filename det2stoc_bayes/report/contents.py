"""What the page says in words and tables: the finding and the screening, as text ready to print."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr
from markupsafe import Markup, escape

from det2stoc_bayes.mismatch.finding import Element
from det2stoc_bayes.report import numbers

BADGES = {"mismatch": "Mismatch found", "no_mismatch": "No mismatch found", "inconclusive": "Inconclusive"}
PEOPLE = {"coulomb": "Coulomb", "stribeck": "Stribeck", "magnus": "Magnus"}
SHOWN = 0.005  # probability: what is smaller stands as under one percent


def words(name: str) -> str:
    """`coulomb_friction` as `Coulomb friction`."""
    return " ".join(PEOPLE.get(word, word) for word in name.split("_"))


def formula(law: str) -> str:
    """A law with real minus signs."""
    return law.replace("-", "−")


def place(element: Mapping[str, Any] | None) -> str:
    """What an element is called; nothing where there is none."""
    return Element.model_validate(element).label if element else ""


def linked(text: str, word: str, target: str) -> Markup:
    """The text with its first such word as a link within the page."""
    link = f'<a href="#{target}">{word}</a>'
    return Markup(re.sub(rf"\b{word}\b", link, str(escape(text)), count=1))


def parameter_rows(parameters: Mapping[str, Any]) -> list[dict[str, str]]:
    """Name, value, interval and unit of each parameter; names and curves are said in words."""
    rows = []
    for name, value in parameters.items():
        row = {"name": words(name), "value": numbers.MISSING, "interval": numbers.MISSING, "unit": ""}
        if isinstance(value, Mapping) and "mean" in value:
            row["value"] = numbers.plus_minus(value["mean"], value.get("sd"))
            row["interval"] = numbers.interval(value.get("interval"))
            row["unit"] = str(value.get("unit", ""))
        elif isinstance(value, Mapping):
            row["value"] = f"a curve of {len(value.get('x', ()))} points, in diagnosis.json"
        else:
            row["value"] = value if isinstance(value, str) else ", ".join(map(str, value))
        rows.append(row)
    return rows


def improvement(fit: Mapping[str, Any], units: Mapping[str, str]) -> list[dict[str, Any]]:
    """Held-out rollout error by channel, before, after and of the noise; the worst before comes first."""
    before, after, noise = (fit.get(f"rollout_rmse_{which}", {}) for which in ("before", "after", "noise"))
    rows = []
    for channel, value in before.items():
        limit, now = noise.get(channel), after.get(channel)
        largest = max(v for v in (value, now, limit, 1e-300) if v is not None)
        rows.append(
            {
                "channel": channel,
                "unit": units.get(channel, ""),
                **{which: numbers.number(v) for which, v in (("before", value), ("after", now), ("noise", limit))},
                "bars": [100 * (v or 0.0) / largest for v in (value, now, limit)],
                "ratio": (value or 0.0) / limit if limit else 0.0,
                "fall": numbers.percent(1 - now / value) if value and now is not None and now <= value else None,
            }
        )
    return sorted(rows, key=lambda row: -row["ratio"])


def screening_rows(fit: xr.DataTree, finding: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The screened candidates by probability, classes together, then by log evidence."""
    if "screening" not in fit:
        return []
    table = fit["screening"].to_dataset()
    rows = []
    for i in range(table.sizes.get("candidate", 0)):
        one = {str(key): table[key].values[i] for key in table.variables if table[key].dims == ("candidate",)}
        evidence = float(one.get("log_evidence", "nan"))
        probability = float(one.get("probability", "nan"))
        rows.append(
            {
                "key": (str(one["name"]), str(one["kind"]), str(one["element"])),
                "chance": probability if probability >= SHOWN else 0.0,
                "name": words(str(one["name"])),
                "place": place({"kind": str(one["kind"]), "name": str(one["element"])}),
                "probability": numbers.percent(probability),
                "bar": 100 * probability if probability >= 0 else 0.0,
                "log_evidence": numbers.nats(evidence),
                "size": str(one.get("size", "")) or numbers.MISSING,
                "same": "",
                "evidence": evidence,
            }
        )
    rows.sort(key=lambda row: (-row["chance"], -row["evidence"]))
    _one_probability_a_class(rows, finding)
    return sorted(rows, key=lambda row: (-row["chance"], len(row["same"])))  # stable: by evidence within each


def _one_probability_a_class(rows: Sequence[dict[str, Any]], finding: Mapping[str, Any]) -> None:
    """Marks rows that share their class's probability with the member that the finding names.

    A class is known by its probability, which is the same number in all of its rows. The finding names one member of
    each, and all equivalents of an effect: what else is in an effect's class contains one of these.
    """
    effects = finding["effects"]
    told = [*effects, *finding["candidates"], *(other for effect in effects for other in effect["alternatives"])]
    named = [_key(one) for one in told]
    equal = {_key(effect): {_key(other) for other in effect["equivalent"]} for effect in effects}
    for chance in {row["chance"] for row in rows} - {0.0}:
        alike = [row for row in rows if row["chance"] == chance]
        first = min(alike, key=lambda row: named.index(row["key"]) if row["key"] in named else len(named))
        for row in alike:
            if row is first or row["key"] in named:
                continue
            larger = first["key"] in equal and row["key"] not in equal[first["key"]]
            row["same"] = "same class, contains a simpler one" if larger else "same class"


def _key(one: Mapping[str, Any]) -> tuple[str, str, str]:
    element = one.get("element") or {}
    return one["name"], element.get("kind", ""), element.get("name", "")


def listed_candidates(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Candidates or alternatives of a finding, the most probable first."""
    ranked = sorted(entries, key=lambda entry: -(entry.get("probability") or 0.0))
    return [
        {
            "name": words(entry["name"]),
            "place": place(entry.get("element")),
            "probability": numbers.percent(entry.get("probability")),
            "bar": 100 * (entry.get("probability") or 0.0),
            "statement": entry.get("statement", ""),
            "law": formula(entry.get("law", "")),
            "parameters": parameter_rows(entry.get("parameters", {})),
        }
        for entry in ranked
    ]


def plain_items(value: Any) -> list[tuple[str, str]]:
    """An experiment's input or initial state as (name, value) pairs."""
    if value is None or value == {} or value == []:
        return []
    if isinstance(value, Mapping):
        return [(str(key), _short(item)) for key, item in value.items()]
    return [("", _short(value))]


def _short(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return str(value)
    if isinstance(value, float | int):
        return f"{value:.4g}".replace("-", "−")
    if isinstance(value, Sequence) and not isinstance(value, str):
        shown = ", ".join(_short(item) for item in value[:8])
        return shown + (f", … ({len(value)} values)" if len(value) > 8 else "")
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_short(item)}" for key, item in value.items())
    return str(value)
