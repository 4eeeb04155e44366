"""How far a diagnosis can be believed, in sentences: draws, stacking, predictive check, exact chains."""

from collections.abc import Mapping
from typing import Any

from det2stoc_bayes.mismatch.predictive import FAILS
from det2stoc_bayes.report import numbers

RELIABLE = 0.7  # k-hat
SMALLEST = 0.001  # p-value that is told as a number
WAYS = {
    "laplace": "{draws} draws of the Gaussian at the fit, widened by the misfit that remains",
    "laplace+psis": "{draws} draws of the Gaussian at the fit, weighted by the exact likelihood",
    "adapted": "{draws} draws of an adapted proposal, weighted by the exact likelihood",
    "smc": "{draws} particles moved to the posterior by tempering",
    "nuts": "{draws} draws by NUTS on the exact likelihood",
}


def belief_lines(finding: Mapping[str, Any]) -> list[str]:
    """One sentence for each check that the finding holds."""
    out = _draws(finding.get("belief")) + _exact(finding.get("exact")) + _stacked(finding.get("stacking"))
    return out + _predicted(finding.get("predictive_check"))


def _draws(belief: Mapping[str, Any] | None) -> list[str]:
    if not belief:
        return []
    after = belief["after"]
    text = f"Intervals come from {WAYS[after['method']].format(draws=after['draws'])}"
    k = after["k_hat"]
    if after["method"] in ("smc", "nuts") or k is None:
        return [f"{text}."]
    if after["method"] == "laplace":
        text = f"Intervals are those of the Gaussian at the fit ({after['draws']} draws): "
        text += f"weighing by the exact likelihood failed (k-hat {numbers.number(k, 2)}), "
        text += "intervals may be wrong; try --exact"
        return [f"{text}."]
    trust = "reliable" if k < RELIABLE else "not reliable: intervals may be too narrow; try --exact"
    return [f"{text} (k-hat {numbers.number(k, 2)}, {trust})."]


def _exact(compared: list[Mapping[str, Any]] | None) -> list[str]:
    out = []
    for one in compared or []:
        if one["agree"] is None:
            r_hat = numbers.number(one["r_hat"], 3)
            out.append(f"The chains of NUTS for {one['hypothesis']} did not mix (R-hat {r_hat}): no comparison.")
            continue
        words = "agree" if one["agree"] else "differ"
        text = f"NUTS and the cheap draws of {one['hypothesis']} {words}"
        if one["unknowns"]:
            means = max(abs(u["mean_difference"]) for u in one["unknowns"].values())
            ratios = [u["sd_ratio"] for u in one["unknowns"].values()]
            span = f"{numbers.number(min(ratios), 2)} to {numbers.number(max(ratios), 2)}"
            text += f": means within {numbers.number(means, 2)} Monte-Carlo errors, ratio of sds {span}"
        out.append(f"{text}.")
    return out


def _stacked(weights: Mapping[str, float] | None) -> list[str]:
    if not weights:
        return []
    shares = ", ".join(f"{name} {numbers.percent(share)}" for name, share in weights.items())
    return [f"Weights that predict left-out recordings best: {shares}."]


def _predicted(check: Mapping[str, Any] | None) -> list[str]:
    if not check or check["p_value"] is None:
        return []
    value = check["p_value"]
    p = f"p = {numbers.number(value, 2)}" if value >= SMALLEST else f"p < {SMALLEST:g}"
    if value < FAILS:
        where = check["worst_channel"]
        return [f"Recordings made by this simulator would not leave so large an error on {where} ({p})."]
    return [f"Recordings made by this simulator would leave as large an error ({p})."]
