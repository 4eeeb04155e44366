"""What the page says in words and tables: the finding and the screening, as text ready to print."""

from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from det2stoc_bayes.report import numbers

BADGES = {"mismatch": "Mismatch found", "no_mismatch": "No mismatch found", "inconclusive": "Inconclusive"}
PEOPLE = {"coulomb": "Coulomb", "stribeck": "Stribeck", "magnus": "Magnus"}


def words(name: str) -> str:
    """`coulomb_friction` as `Coulomb friction`."""
    return " ".join(PEOPLE.get(word, word) for word in name.split("_"))


def formula(law: str) -> str:
    """A law with real minus signs."""
    return law.replace("-", "−")


def place(element: Mapping[str, Any] | None) -> str:
    """`joint wrist`; a name that says no more than its kind is said once."""
    if not element:
        return ""
    kind, name = element["kind"], element["name"]
    return name if kind == name or kind == "sensor" and name == "time" else f"{kind} {name}"


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


def screening_rows(fit: xr.DataTree) -> list[dict[str, Any]]:
    """The screened candidates by probability, then log evidence."""
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
                "name": words(str(one["name"])),
                "place": place({"kind": str(one["kind"]), "name": str(one["element"])}),
                "probability": numbers.percent(probability),
                "bar": 100 * probability if probability >= 0 else 0.0,
                "log_evidence": numbers.nats(evidence),
                "size": str(one.get("size", "")) or numbers.MISSING,
                "order": (-probability if probability >= 0.005 else 0.0, -evidence),
            }
        )
    return sorted(rows, key=lambda row: row["order"])


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
