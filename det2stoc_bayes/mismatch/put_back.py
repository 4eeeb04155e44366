"""A fit without its last effect, where it stands: what an effect explains to first order is there to be explained."""

from dataclasses import replace

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.optimize import Fit, summarize


def put_back(fit: Fit) -> Fit:
    """No optimum, but the fit's own linearization; the other unknowns stay as they are.

    What is put back is what the effect's unknowns change to first order: of a ripple or an attraction a rough guess.
    """
    problem, own = fit.problem, fit.problem.effects[-1]
    size, z = problem.size - own.size, fit.point.z
    explained = fit.linear.columns[..., size:] @ z[size:, None]
    plain = replace(
        fit.linear,
        problem=problem.with_effects(problem.effects[:-1]),
        point=Point(z[:size], fit.point.start),
        stacked=fit.linear.stacked + explained,
        columns=fit.linear.columns[..., :size],
    )
    return summarize(plain, True, "unfinished")
