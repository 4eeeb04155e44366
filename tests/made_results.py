"""A folder of results of every kind that is one JSON file, as the commands write them."""

import json
from pathlib import Path
from typing import Any


def _diagnosis(mass: float) -> dict[str, Any]:
    element = {"kind": "joint", "name": "wrist"}
    force = {"mean": 0.31, "sd": 0.01, "interval": [0.29, 0.33], "unit": "N m"}
    psi = {"before": {"mean": mass, "sd": 0.1}, "after": {"mean": 1.2, "sd": 0.1}, "prior_conflict": 0.02}
    errors = {f"rollout_rmse_{which}": {"qpos/wrist": 0.1} for which in ("before", "after", "noise")}
    return {
        "verdict": "mismatch", "summary": "Dry friction of 0.31 +- 0.01 N m on joint wrist is missing.",
        "evidence": {"log10_bayes_factor": 210.3, "noise_inflation": 41.0}, "candidates": [],
        "seconds": 41.0, "seed": 3,
        "where": {"elements": [element | {"share": 0.93}], "when": []}, "fit": errors | {"unexplained_share": 0.03},
        "effects": [{"name": "coulomb_friction", "element": element, "probability": 0.97, "explains": 0.8,
                     "parameters": {"force": force}}],
        "psi": {"mass": psi},
    }  # fmt: skip


def _blind() -> dict[str, Any]:
    tally = {"name": "effect", "cases": 2, "right": 1, "false_claims": 0}
    coverage = [{"name": "both", "inside": 3, "count": 4}]
    return {"kinds": [tally], "systems": [], "coverage": coverage, "cases": [{"right": True}, {"right": False}]}


def _calibration() -> dict[str, Any]:
    unknown = {"name": "mass", "p_chi2": 0.4, "p_uniform": 0.2, "mean": 0.49}
    told = {
        "problem": "pendulum",
        "method": "laplace",
        "calibrated": True,
        "verdict": "calibrated at 1 %",
        "failed": [],
    }
    told |= {"num_replications": 500, "num_draws": 99, "num_few_effective": 0, "simulations": 9, "seconds_run": 2.0}
    return told | {"seed": 0, "tarp": {"p": 0.3}, "unknowns": [unknown]}


def write_results(folder: Path) -> Path:
    """The folder, with seven results of which one is broken, and things that are no results."""
    row = {"label": "laplace", "verdict": "trust", "why": "C2ST 0.51", "ess": 400.0, "r_hat": None, "c2st": 0.51}
    comparison = {"reference": {"label": "emcee"}, "failed": {"npe": "no"}, "rows": [row | {"seconds_run": 1.0}]}
    files = {
        "first/diagnosis.json": _diagnosis(1.9),
        "second/diagnosis.json": _diagnosis(2.4),
        "methods/comparison.json": comparison,
        "ranks/calibration.json": _calibration(),
        "hidden_effects/blind.json": _blind(),
        "old/results.json": {"experiment": "trivariate", "kl": {"mean": 0.002}},
        "broken/diagnosis.json": {"verdict": "mismatch"},
        ".hidden/diagnosis.json": _diagnosis(1.0),
        "nothing/other.json": {},
    }
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
    for name in ("first", "second", ".hidden"):
        (folder / name / "report.html").write_text(f"<p>{name}</p>")
    (folder / "first" / "effects.py").write_text("print(1)")
    (folder / "first" / "notes.bin").write_bytes(b"\0")
    return folder
