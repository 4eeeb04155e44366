"""The page of a diagnosis: what was left out, where, how sure that is, and how much better the model got."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from det2stoc_bayes.mismatch.finding import SURE
from det2stoc_bayes.report import (
    belief_lines,
    contents,
    curves,
    figures,
    marginals,
    numbers,
    page,
    replay,
    series,
    varying,
)

WRITTEN = ("patched.xml", "effects.py", "fit.nc", "diagnosis.json")
KNOT = re.compile(r"\]\.curve\.\d+$")
NAMES = {
    "mismatch": {"before": "before", "after": "after"},
    "inconclusive": {"before": "before", "after": "best candidate"},
    "no_mismatch": {"before": "model, refitted"},
}


def diagnosis_page(
    finding: Mapping[str, Any], fit: xr.DataTree, *, study_name: str, files: Sequence[str] = WRITTEN
) -> str:
    """The report as html text, from diagnosis.json's content and the fit; it neither samples nor simulates.

    `files` names what was written beside the report. The groups of `fit` that the page draws are optional:
    a section whose data are missing is left out.
    """
    rollouts = _rollouts(fit)
    if not finding["where"]["when"]:
        rollouts = {stem: data.drop_vars("condition", errors="ignore") for stem, data in rollouts.items()}
    names = _names(finding["verdict"], fit, rollouts)
    moving = replay.scene(fit, names, finding)
    return page.render(
        "diagnosis.html.j2",
        title=f"{study_name}: {contents.BADGES[finding['verdict']].lower()}",
        study=study_name,
        finding=finding,
        summary=contents.linked(numbers.tied(finding["summary"]), "psi", "word-psi"),
        verdict=finding["verdict"],
        badge=contents.BADGES[finding["verdict"]],
        names=names,
        effects=[_effect(effect) for effect in finding["effects"]],
        candidates=contents.listed_candidates(finding["candidates"]),
        doubted=finding["verdict"] == "inconclusive" and any(c["probability"] >= SURE for c in finding["candidates"]),
        negligible=_negligible(finding),
        improvement=contents.improvement(finding["fit"], _units(rollouts)),
        bayes_factor=numbers.bayes_factor(finding["evidence"]["log10_bayes_factor"]),
        density=_density(finding["fit"]),
        belief=belief_lines.belief_lines(finding),
        screening=contents.screening_rows(fit, finding),
        recordings=_recordings(rollouts, names, replay.worst(moving)),
        replay=moving and page.embedded(moving),
        factors=replay.FACTORS,
        enlarged=replay.enlarged(moving),
        traced=replay.traced(moving),
        marked=moving is not None and bool(moving["marks"]),
        omitted=len(rollouts) - len(series.selection(rollouts)[0]),
        distribution=_distribution(rollouts, names),
        **_posterior(finding, fit, names),
        experiment=_experiment(finding["experiment"]),
        sensitivity=finding.get("sensitivity") or [],
        files=list(files),
        number=numbers.number,
        percent=numbers.percent,
        duration=numbers.duration,
        tied=numbers.tied,
        words=contents.words,
        place=contents.place,
    )


def _names(verdict: str, fit: xr.DataTree, rollouts: Mapping[str, xr.Dataset]) -> dict[str, str]:
    """What the page calls the two models; the second one is dropped where the fit does not hold it."""
    has_after = all("after" in data for data in rollouts.values()) if rollouts else "after" in fit
    return {which: name for which, name in NAMES[verdict].items() if which == "before" or has_after}


def _rollouts(fit: xr.DataTree) -> dict[str, xr.Dataset]:
    if "rollouts" not in fit:
        return {}
    return {stem: node.to_dataset() for stem, node in fit["rollouts"].children.items()}


def _units(rollouts: Mapping[str, xr.Dataset]) -> dict[str, str]:
    """Unit of each channel, where the rollouts say it."""
    found: dict[str, str] = {}
    for data in rollouts.values():
        if "unit" in data.coords:
            found |= dict(zip(map(str, data["channel"].values), map(str, data["unit"].values), strict=True))
    return found


def _recordings(
    rollouts: Mapping[str, xr.Dataset], names: Mapping[str, str], worst: Mapping[str, float]
) -> list[dict[str, Any]]:
    """One entry a recording shown: its figures, the worst predicted channels apart from the others.

    `worst` holds the moments [s] at which those that are replayed are shown first.
    """
    stems, points = series.selection(dict(rollouts))
    shown = []
    for stem in stems:
        data = rollouts[stem]
        order = series.channel_order(data)
        held_out = data.attrs.get("role") == "holdout"
        shown.append(
            {
                "stem": stem,
                "begin": float(data["time"].min()),
                "end": float(data["time"].max()),
                "worst": worst.get(stem, series.worst_moment(data)),
                "held_out": held_out,
                "misfit": [numbers.number(series.misfit(data, which), 2) for which in names],
                "condition": "condition" in data and bool(data["condition"].any()),
                "panels": [
                    {
                        "channels": group,
                        "rollout": page.embedded(figures.rollout_figure(data, group, names, points)),
                        "residual": page.embedded(figures.residual_figure(data, group, names, points)),
                    }
                    for group in (order[: series.PANELS_OPEN], order[series.PANELS_OPEN :])
                    if group
                ],
            }
        )
    return sorted(shown, key=lambda one: not one["held_out"])


def _distribution(rollouts: Mapping[str, xr.Dataset], names: Mapping[str, str]) -> dict[str, Any] | None:
    """All whitened residuals together: of the held-out recordings where there are any."""
    held_out = [data for data in rollouts.values() if data.attrs.get("role") == "holdout"]
    chosen = held_out or list(rollouts.values())
    if not chosen:
        return None
    residuals = {}
    for which in names:
        values = np.concatenate([data[f"residual_{which}"].values.ravel() for data in chosen])
        residuals[which] = values[np.isfinite(values)]
    return {
        "held_out": bool(held_out),
        "samples": f"{residuals['before'].size:,}",
        "rms": {which: numbers.number(float(np.sqrt(np.mean(v**2))), 3) for which, v in residuals.items() if v.size},
        "beyond": {
            which: numbers.percent(float(np.mean(np.abs(v) > 2)), 1) for which, v in residuals.items() if v.size
        },
        "histogram": page.embedded(figures.histogram_figure(residuals, names)),
        "quantiles": page.embedded(figures.quantile_figure(residuals, names)),
    }


def _posterior(finding: Mapping[str, Any], fit: xr.DataTree, names: dict[str, str]) -> dict[str, Any]:
    """Table rows and densities of psi and of the effects' parameters."""
    psi, effects = marginals.marginals(fit)
    spread = [
        {"label": name, "figure": page.embedded(figure), "height": figure["layout"]["height"]}
        for name, figure in varying.varying_figures(fit, names)
    ]
    rows = []
    for one in psi:
        conflict = finding["psi"].get(one.variable, {}).get("prior_conflict")
        conflict = conflict if isinstance(conflict, float | int) else min(filter(None, conflict or []), default=None)
        over = finding["psi"].get(one.variable, {}).get("over_equivalents")
        told = {"conflict": numbers.number(conflict, 2), "odd": (conflict or 1) < 0.05}
        rows.append(_marginal(one, names) | told | {"over": numbers.interval(over) if over else ""})
    single = [one for one in effects if not KNOT.search(one.variable)]  # a curve has a figure of its own
    return {"psi": rows, "effect_parameters": [_marginal(one, names) for one in single], "varying": spread}


def _marginal(one: marginals.Marginal, names: dict[str, str]) -> dict[str, Any]:
    return {
        "label": one.title,
        "unit": one.unit,
        "before": one.row("before"),
        "after": one.row("after"),
        "shift": one.shift,
        "prior": one.prior is not None,
        "figure": page.embedded(marginals.density_figure(one, names)),
    }


def _effect(effect: Mapping[str, Any]) -> dict[str, Any]:
    recordings = effect["recordings"]
    return {
        "name": contents.words(effect["name"]),
        "place": contents.place(effect["element"]),
        "statement": effect["statement"],
        "law": contents.formula(effect["law"]),
        "probability": numbers.percent(effect["probability"]),
        "explains": numbers.percent(effect["explains"]),
        "recordings": "all recordings" if recordings == "all" else ", ".join(recordings),
        "parameters": contents.parameter_rows(effect["parameters"]),
        "curve": page.embedded(curves.curve_figure(effect["parameters"])) if "curve" in effect["parameters"] else "",
        "by_recording": [
            {"recording": part["recording"], "kind": part["kind"], "explains": numbers.percent(part["explains"])}
            for part in effect.get("by_recording") or []
        ],
        "alternatives": contents.listed_candidates(effect["alternatives"]),
        "equivalent": [
            {
                "name": contents.words(other["name"]),
                "place": contents.place(other["element"]),
                "parameters": contents.parameter_rows(other["parameters"]),
                "psi": [
                    f"{name} {numbers.plus_minus(m['mean'], m['sd'])}" for name, m in (other.get("psi") or {}).items()
                ],
            }
            for other in effect["equivalent"]
        ],
    }


def _negligible(finding: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "statement": one.get("statement") or f"{contents.words(one['name'])} at {contents.place(one['element'])}",
            "explains": numbers.percent(one.get("explains")),
        }
        for one in finding.get("negligible") or []
    ]


def _density(fit: Mapping[str, Any]) -> str:
    before, after = fit["heldout_log_density_before"], fit["heldout_log_density_after"]
    if before is None or after is None or before == after:
        return ""
    gain = numbers.plus_minus(fit["difference"], fit["standard_error"])
    return f"{numbers.nats(before)} → {numbers.nats(after)} nats, a gain of {gain}"


def _experiment(experiment: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if experiment is None:
        return None
    gain = experiment["expected_gain"]  # none is computed where bodies touch
    return {
        "text": experiment["text"],
        "gain": None if gain is None else numbers.number(gain, 2),
        "input": contents.plain_items(experiment["input"]),
        "initial_state": contents.plain_items(experiment["initial_state"]),
    }
