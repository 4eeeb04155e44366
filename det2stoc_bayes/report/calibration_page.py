"""The page of a calibration: the verdict, what each unknown's ranks say, and all unknowns together."""

from det2stoc_bayes.calibration import LEVEL, Calibration, Unknown
from det2stoc_bayes.report import calibration_figures as figures
from det2stoc_bayes.report import numbers, page

MOST_SHOWN = 24  # unknowns with figures


def calibration_page(found: Calibration) -> str:
    """The report as html text."""
    shown = list(enumerate(found.unknowns))[:MOST_SHOWN]
    return page.render(
        "calibration.html.j2",
        title=f"{found.method} on {found.problem}: calibration",
        verdict="no_mismatch" if found.calibrated else "mismatch",
        badge="Calibrated" if found.calibrated else "Not judged" if found.unjudged else "Not calibrated",
        found=found,
        level=f"{LEVEL:.0%}",
        rows=[_row(u) for u in found.unknowns],
        p_tarp=numbers.number(found.p_tarp, 2),
        unknowns=[
            (
                u.name,
                page.embedded(figures.rank_figure(found.ranks[:, j], found.num_draws)),
                page.embedded(figures.difference_figure(found.ranks[:, j], found.num_draws)),
            )
            for j, u in shown
        ],
        left_out=len(found.unknowns) - len(shown),
        together=page.embedded(figures.coverage_figure(found.credibility)),
    )


def _row(unknown: Unknown) -> dict[str, object]:
    shape = unknown.shape if unknown.rejected else "even"
    told = (unknown.p_chi2, unknown.p_uniform, unknown.mean, unknown.spread, unknown.sd)
    values = [numbers.number(v, 2) for v in told]
    return {"name": unknown.name, "rejected": unknown.rejected, "shape": shape, "values": values}
