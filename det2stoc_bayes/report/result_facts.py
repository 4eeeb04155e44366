"""What each kind of result says: a verdict, a line, and facts by section, so that two of a kind stand side by side."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from det2stoc_bayes import posterior
from det2stoc_bayes.doubts import misfit
from det2stoc_bayes.report import contents, numbers
from det2stoc_bayes.report.summary import predicted, summarize

NORMAL = 1.959964  # sds on either side of a normal's mean that hold 95 %

type Facts = tuple[tuple[str, tuple[Fact, ...]], ...]
type Told = tuple[str, str, Facts]


@dataclass(frozen=True)
class Fact:
    """A label and its text; `interval` (low, mean, high) where it is drawn as well."""

    label: str
    text: str
    interval: tuple[float, float, float] | None = None


def of_diagnosis(told: Mapping[str, Any]) -> Told:
    """From diagnosis.json."""
    evidence, fit = told["evidence"], told["fit"]
    about = (
        Fact("verdict", contents.BADGES[told["verdict"]]),
        Fact("log10 Bayes factor", numbers.number(evidence["log10_bayes_factor"])),
        Fact("noise inflation", numbers.number(evidence["noise_inflation"])),
        Fact("unexplained share", numbers.percent(fit.get("unexplained_share"))),
        *_run(told),
    )
    psi = [
        _moments(name, which, values[which]) for name, values in told["psi"].items() for which in ("before", "after")
    ]
    errors = [
        Fact(f"{channel}, {which}", numbers.number(value))
        for which in ("before", "after", "noise")
        for channel, value in fit.get(f"rollout_rmse_{which}", {}).items()
    ]
    sections = {
        "About": about,
        "Left out": [fact for effect in told["effects"] for fact in _effect(effect)],
        "Candidates": [Fact(_named(c), numbers.percent(c["probability"])) for c in told["candidates"]],
        "Where": [Fact(contents.place(e), numbers.percent(e["share"])) for e in told["where"]["elements"]],
        "Held-out error (rms)": errors,
        "psi": psi,
    }
    return told["verdict"], numbers.tied(told["summary"]), _sections(sections)


def of_fit(folder: Path) -> Told:
    """From fit.nc."""
    tree = posterior.load(folder)
    rows, held = summarize(tree), predicted(tree)
    keys = ("method", "num_samples", "noise_inflation", "simulations", "gradients", "seconds_run", "seed", "k_hat")
    about = [Fact(key.replace("_", " "), _value(tree.attrs[key])) for key in keys if key in tree.attrs]
    about += [Fact("options", _value(tree.attrs["options"]))] if "options" in tree.attrs else []
    sections = {
        "About": about,
        "Posterior": [
            Fact(r.name, numbers.plus_minus(r.mean, r.sd), (r.interval[0], r.mean, r.interval[1])) for r in rows
        ],
        "95 % interval": [Fact(r.name, numbers.interval(r.interval)) for r in rows],
        "R-hat": [Fact(r.name, numbers.number(r.r_hat)) for r in rows if r.r_hat is not None],
        "Effective draws": [Fact(r.name, numbers.number(r.ess, 3)) for r in rows if r.ess is not None],
        "Held-out log density a transition [nat]": [Fact(h.recording, numbers.number(h.matched)) for h in held],
    }
    line = ", ".join(f"{r.name} {numbers.plus_minus(r.mean, r.sd)}" for r in rows[:4])
    line = line or f"{len(held)} recordings predicted"
    if misfit(tree):
        line += f"; misfit {_value(tree.attrs['noise_inflation'])} × noise: do not trust the widths"
    return str(tree.attrs.get("method", "")), line, _sections(sections)


def of_comparison(told: Mapping[str, Any]) -> Told:
    """From comparison.json."""
    trusted = [row["label"] for row in told["rows"] if row["verdict"] == "trust"]
    reference = told["reference"]
    columns = {
        "Effective draws": "ess", "R-hat": "r_hat", "C2ST": "c2st", "k-hat": "k_hat", "Means off by [sd]": "mean_error",
        "Seconds": "seconds_run", "Simulations": "simulations",
    }  # fmt: skip
    sections: dict[str, Iterable[Fact]] = {
        "About": [Fact("reference", reference["label"] if reference else numbers.MISSING)],
        "Verdicts": [Fact(row["label"], f"{row['verdict']}: {row['why']}") for row in told["rows"]]
        + [Fact(label, f"could not run: {why}") for label, why in told["failed"].items()],
        "Against the model": [Fact("whatever the method", doubt) for doubt in told.get("doubts") or ()],
    }
    for title, key in columns.items():
        sections[title] = [Fact(r["label"], numbers.number(r[key])) for r in told["rows"] if r.get(key) is not None]
    line = f"{', '.join(trusted)} can be trusted" if trusted else "no method can be trusted as it ran"
    verdict = "trusted" if trusted else "not trusted"
    if told.get("doubts"):
        verdict = "model in doubt" if trusted else verdict
        line += (
            " to draw the posterior, of a model that the recordings speak against"
            if trusted
            else ", and the recordings speak against the model"
        )
    return verdict, line, _sections(sections)


def of_calibration(told: Mapping[str, Any]) -> Told:
    """From calibration.json."""
    keys = ("problem", "method", "num_replications", "num_draws", "num_few_effective", "simulations")
    about = [Fact(key.replace("_", " "), _value(told[key])) for key in keys]
    about += [
        Fact("failed", str(len(told["failed"]))),
        Fact("p of TARP", numbers.number(told["tarp"]["p"], 2)),
        *_run(told),
    ]
    unknowns = told["unknowns"]
    sections = {
        "About": about,
        "p of even ranks (chi-squared)": [Fact(u["name"], numbers.number(u["p_chi2"], 2)) for u in unknowns],
        "p of even ranks (Kolmogorov-Smirnov)": [Fact(u["name"], numbers.number(u["p_uniform"], 2)) for u in unknowns],
        "Mean of ranks": [Fact(u["name"], numbers.number(u["mean"], 3)) for u in unknowns],
    }
    verdict = "calibrated" if told["calibrated"] else "not calibrated"
    return verdict, f"{told['method']} on {told['problem']}: {told['verdict']}", _sections(sections)


def of_blind(told: Mapping[str, Any]) -> Told:
    """From blind.json."""
    kinds = {
        row["name"]: f"{_of(row['right'], row['cases'])} right, {row['false_claims']} false claims"
        for row in told["kinds"]
    }
    systems = {row["name"]: f"{_of(row['right'], row['cases'])} right" for row in told["systems"]}
    coverage = {row["name"]: f"{_of(row['inside'], row['count'])}" for row in told["coverage"] if row["count"]}
    right = sum(bool(case["right"]) for case in told["cases"])
    about = [Fact(key, str(told[key])) for key in ("seed", "commit", "log") if told.get(key)]
    sections = {
        "About": [*about, Fact("cases", str(len(told["cases"])))],
        "By kind": [Fact(*item) for item in kinds.items()],
        "By system": [Fact(*item) for item in systems.items()],
        "95 % intervals that hold the truth": [Fact(*item) for item in coverage.items()],
    }
    line = f"{_of(right, len(told['cases']))} concealed studies told right"
    return numbers.percent(right / len(told["cases"])) if told["cases"] else "empty", line, _sections(sections)


def of_reproduction(told: Mapping[str, Any]) -> Told:
    """From results.json, whose tables are the experiment's own."""
    facts = [Fact(label, text) for label, text in _flat(told) if label]
    name = str(told.get("experiment", "experiment"))
    return name, f"{name}: {len(facts)} numbers", _sections({"Numbers": facts[:400]})


READERS: dict[str, Callable[[Any], Told]] = {
    "diagnosis": of_diagnosis,
    "fit": of_fit,
    "comparison": of_comparison,
    "calibration": of_calibration,
    "blind": of_blind,
    "reproduction": of_reproduction,
}


def _sections(parts: Mapping[str, Iterable[Fact]]) -> Facts:
    made = ((title, tuple(facts)) for title, facts in parts.items())
    return tuple((title, facts) for title, facts in made if facts)


def _named(one: Mapping[str, Any]) -> str:
    return f"{contents.words(one['name'])}, {contents.place(one['element'])}"


def _effect(effect: Mapping[str, Any]) -> Iterable[Fact]:
    name = _named(effect)
    yield Fact(
        name, f"probability {numbers.percent(effect['probability'])}, explains {numbers.percent(effect['explains'])}"
    )
    for row in contents.parameter_rows(effect["parameters"]):
        yield Fact(f"{name}: {row['name']}", " ".join(filter(None, (row["value"], row["unit"]))))


def _moments(name: str, which: str, told: Mapping[str, Any]) -> Fact:
    mean, sd = told.get("mean"), told.get("sd")
    text = numbers.plus_minus(mean, sd)
    if not isinstance(mean, int | float) or not isinstance(sd, int | float):
        return Fact(f"{name}, {which}", text)
    return Fact(f"{name}, {which}", text, (mean - NORMAL * sd, mean, mean + NORMAL * sd))


def _run(told: Mapping[str, Any]) -> list[Fact]:
    keys = (key for key in ("seconds", "seconds_run", "seed") if told.get(key) is not None)
    return [Fact(key.replace("_", " "), _value(told[key])) for key in keys]


def _of(some: int, all_of_them: int) -> str:
    return f"{some} of {all_of_them}"


def _value(value: Any) -> str:
    return numbers.number(value) if isinstance(value, float) else str(value)


def _flat(told: Any, label: str = "") -> Iterable[tuple[str, str]]:
    """Scalars of nested tables, by their way; lists of numbers are left to the page."""
    if isinstance(told, Mapping):
        for key, value in told.items():
            yield from _flat(value, f"{label} / {key}" if label else str(key))
    elif isinstance(told, str | int | float) and not isinstance(told, bool):
        yield label, _value(told)
