"""The page of the analytic check: learned conditional densities against the exact ones."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from det2stoc_bayes.report import canvas, numbers, page
from det2stoc_bayes.report.canvas import Spec


def trivariate_page(result: Mapping[str, Any]) -> str:
    """The report as html text, from results.json's content."""
    found, allowed = result["divergence"], result["allowed"]
    reached = all(found[k] <= allowed[k] for k in allowed)
    return page.render(
        "trivariate.html.j2",
        title="Analytic check: a CVAE against trivariate Gaussians",
        verdict="no_mismatch" if reached else "mismatch",
        badge="Within bounds" if reached else "Out of bounds",
        result=result,
        figures=[
            (step, page.embedded(density_figure(result["cases"][0], step)))
            for step in sorted(result["cases"][0]["densities"], key=int)
        ],
        rows=[_row(case) for case in result["cases"]],
        steps=sorted(result["cases"][0]["divergence_by_step"], key=int),
        number=numbers.number,
    )


def density_figure(case: Mapping[str, Any], step: str) -> Spec:
    """p(s' | s, a) after some steps of training, one panel a condition, the exact one beside it."""
    grid, traces, titles, axes = np.asarray(case["grid"]), [], [], []
    top = 1.1 * max(np.max(case["exact"]), *(np.max(d) for d in case["densities"].values()))
    learned_here = zip(case["conditions"], case["exact"], case["densities"][step], strict=True)
    for row, (condition, exact, learned) in enumerate(learned_here):
        style: Spec = {"y_axis": canvas.y_name(row), "hovertemplate": "%{y:.4~g}"}
        traces.append(canvas.line(grid, np.asarray(exact), "exact", canvas.OBSERVED, line={"dash": "dot"}, **style))
        traces.append(canvas.line(grid, np.asarray(learned), "learned", canvas.AFTER, **style))
        titles.append(f"s = {condition[0]:.2f}, a = {condition[1]:.2f}")
        axes.append({"range": [0.0, top]})
    return {"data": traces, "layout": canvas.panels(titles, "s'", axes)}


def _row(case: Mapping[str, Any]) -> dict[str, Any]:
    divergences = case["divergences"]
    by_step = {step: numbers.number(value) for step, value in case["divergence_by_step"].items()}
    return {
        "number": case["number"],
        "mean": numbers.number(float(np.mean(divergences))),
        "worst": numbers.number(float(np.max(divergences))),
        "by_step": by_step,
    }
