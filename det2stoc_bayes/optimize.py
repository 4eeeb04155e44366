"""Gauss-Newton over the unknowns and the latent starts of several hypotheses at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.linearization import Linearization, Point, linearize, linearize_beside, simulate, tangent
from det2stoc_bayes.newton import Step, newton_step, noise_scale
from det2stoc_bayes.problem import Problem

FRACTIONS = (0.4, 0.1, 0.02)  # of a step that overshoots
STARTS = (1.0, 0.3, 0.05, 0.0)  # of the change of initial states that goes with it
SETTLED = 0.03  # of the tolerance: a step that promises less is not taken
SERVES = 0.2  # of the gain that a fraction of a step promises: with so much the search ends
POOR, PATIENCE = 0.1, 3  # a search ends after so many iterations in a row that gave less than this of their promise
NUM_CHORDS = 4  # steps with the same sensitivities
CONTRACTION = 0.3  # of the last step's gain: a step that promises more needs new sensitivities
NUM_RESPREADS = 8  # rounds in which the spreads of psi by recording settle

# A search that stalled promised more than it gave, as about a kink or along a bent valley; an unfinished one would have
# gone on.
End = Literal["converged", "stalled", "unfinished"]


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at its most probable point."""

    linear: Linearization
    covariance: Float[np.ndarray, "size size"]  # of z, with the noise scale applied
    noise_scale: float  # variance ratio s2 >= 1 under which the covariance holds
    chi2: float  # whitened squared residual, initial states integrated out
    log_likelihood: float  # at s2 = 1
    end: End

    @property
    def problem(self) -> Problem:
        """The hypothesis."""
        return self.linear.problem

    @property
    def point(self) -> Point:
        """Most probable unknowns and initial states."""
        return self.linear.point

    @property
    def noise_inflation(self) -> float:
        """Whitened squared residual over its degrees of freedom: 1 under the right model."""
        free = max(self.linear.degrees_of_freedom - self.problem.size, 1)
        return self.chi2 / self.problem.measurement.mean_square / free


def fit_many(
    points: Sequence[tuple[Problem, Point]],
    *,
    max_iterations: int = 8,
    tolerance: float = 0.05,
    free_scale: bool = True,
) -> list[Fit | None]:
    """Most probable unknowns of every hypothesis; None where its simulations diverge from the start.

    `tolerance` is the expected gain in nats at which an iteration is the last. With `free_scale` a misfit beyond the
    noise widens the noise (s2 >= 1), so that the prior is not swamped by model error. Spreads of psi that varies by
    recording, where the problem holds them, end at their marginal's maximum.
    """
    from det2stoc_bayes.populations import better_spreads, respread

    options = {"tolerance": tolerance, "free_scale": free_scale}
    fits = _fit_held(points, max_iterations=max_iterations, **options)
    for _ in range(NUM_RESPREADS if max_iterations else 0):
        wider = {i: better_spreads(f) for i, f in enumerate(fits) if f is not None}
        again = {i: respread(fits[i], spreads) for i, spreads in wider.items() if spreads is not None}  # type: ignore
        if not again:
            break
        found = _fit_held(list(again.values()), max_iterations=max(max_iterations // 2, 1), **options)
        for i, f in zip(again, found, strict=True):
            fits[i] = f if f is not None else fits[i]
    return fits


def sketch(base: Fit, points: Sequence[tuple[Problem, Point]], *, tolerance: float) -> list[Fit | None]:
    """Roughly `fit_many` of a fit with effects added: the fit's own sensitivities serve first, then new ones once."""
    linear = {i: lin for i, lin in enumerate(linearize_beside(base.linear, points)) if lin is not None}
    first, over = _descended(linear, tolerance, True)
    on = _again({i: lin for i, lin in first.items() if not over[i]})
    linear = first | _descended(on, tolerance, True)[0]
    return [summarize(linear[i], True, "unfinished") if i in linear else None for i in range(len(points))]


def _fit_held(
    points: Sequence[tuple[Problem, Point]], *, max_iterations: int, tolerance: float, free_scale: bool
) -> list[Fit | None]:
    """Gauss-Newton with the spreads held."""
    linear = {i: lin for i, lin in enumerate(linearize(points)) if lin is not None}
    ends: dict[int, End] = dict.fromkeys(linear, "unfinished")
    poor = dict.fromkeys(linear, 0)
    for _ in range(max_iterations):
        todo = {i: linear[i] for i, end in ends.items() if end == "unfinished"}
        if not todo:
            break
        moved, over = _descended(todo, tolerance, free_scale)
        linear |= moved | _again({i: lin for i, lin in moved.items() if not over[i]})
        # What keeps promising more than it gives, as friction does about rest, will not give more.
        ended = [i for i, lin in todo.items() if over[i] or _gained(lin, moved[i], free_scale) < tolerance]
        for i in todo.keys() - ended:
            promised = newton_step(todo[i], free_scale).gain
            poor[i] = poor[i] + 1 if _gained(todo[i], moved[i], free_scale) < POOR * promised else 0
            ended += [i] if poor[i] == PATIENCE else []
        left = {i: newton_step(linear[i], free_scale).gain for i in ended}
        ends |= {i: "converged" if gain < tolerance else "stalled" for i, gain in left.items()}
    return [summarize(linear[i], free_scale, ends[i]) if i in linear else None for i in range(len(points))]


def _again(linear: dict[int, Linearization]) -> dict[int, Linearization]:
    """With new sensitivities where the old ones were taken elsewhere."""
    changed = [i for i, lin in linear.items() if not lin.exact]
    new = linearize([(linear[i].problem, linear[i].point) for i in changed]) if changed else []
    return linear | {i: lin for i, lin in zip(changed, new, strict=True) if lin is not None}


def _descended(
    linear: dict[int, Linearization], tolerance: float, free_scale: bool
) -> tuple[dict[int, Linearization], dict[int, bool]]:
    """Steps that each cost one simulation, with the same sensitivities while they serve; and who has arrived.

    The last step is short and from exact sensitivities, which stay those of the point that it leads to.
    """
    now, over, live = dict(linear), dict.fromkeys(linear, False), set(linear)
    last = dict.fromkeys(linear, np.inf)
    for _ in range(NUM_CHORDS):
        steps = {i: newton_step(now[i], free_scale) for i in live}
        for i in [i for i, step in steps.items() if not step.gain > SETTLED * tolerance]:  # NaN included
            over[i] = now[i].exact
            live.remove(i)
        live = {i for i in live if steps[i].gain <= CONTRACTION * last[i]}
        if not live:
            break
        order = sorted(live)
        trials = _tried([now[i] for i in order], [_moved(now[i], steps[i], 1.0)[0] for i in order])
        stuck = []
        for i, lin in zip(order, trials, strict=True):
            last[i] = steps[i].gain
            if lin is None or _height(lin, steps[i].s2) > _height(now[i], steps[i].s2):
                live.remove(i)
                stuck += [i] if now[i].exact else []
                continue
            if steps[i].gain < tolerance:  # old sensitivities lead a little beside the top: they are not the last word
                over[i] = now[i].exact
                live.remove(i)
            now[i] = lin
        over |= {i: steps[i].gain < tolerance for i in stuck}
        search = [i for i in stuck if not over[i]]
        if search:
            found = _line_search([now[i] for i in search], [steps[i] for i in search])
            over |= {i: lin is None for i, lin in zip(search, found, strict=True)}
            now |= {i: lin for i, lin in zip(search, found, strict=True) if lin is not None}
    return now, over


def _tried(linear: Sequence[Linearization], points: Sequence[Point]) -> list[Linearization | None]:
    """The same sensitivities about other points, each simulated once."""
    requests = [lin.problem.request(p.z[None], p.start) for lin, p in zip(linear, points, strict=True)]
    predicted = simulate([(lin.problem, lin.point) for lin in linear], requests)
    return [lin.about(p, one) for lin, p, one in zip(linear, points, predicted, strict=True)]


def _height(lin: Linearization, s2: float) -> float:
    return float((lin.stacked**2).sum()) / s2 + float(lin.point.z @ lin.point.z)


def _moved(lin: Linearization, step: Step, fraction: float, starts: Sequence[float] = (1.0,)) -> list[Point]:
    """The unknowns a fraction on their way, with fractions of the change of the starts that then is best."""
    z = lin.problem.between(lin.point.z, lin.point.z + step.z, fraction)
    seen = lin.columns @ lin.problem.straightened(z, lin.point.z)
    change = lin.latent.best_start(lin.stacked - seen[..., None])
    return [Point(z, lin.problem.moved(lin.point.start, share * change)) for share in starts]


def _gained(before: Linearization, after: Linearization, free_scale: bool) -> float:
    """What an iteration has gained, nats."""
    square = float((before.latent.project(before.stacked) ** 2).sum())
    s2 = noise_scale(before, square, free_scale)
    return 0.5 * (_height(before, s2) - _height(after, s2))


def _line_search(linear: Sequence[Linearization], steps: Sequence[Step]) -> list[Linearization | None]:
    """The first of several fractions of each step that serves, or the best of all; None where none is an improvement.

    At each fraction every segment takes its own best start: one that overshoots does not hold the others back.
    """
    heights = [_height(lin, step.s2) for lin, step in zip(linear, steps, strict=True)]
    best: list[Linearization | None] = [None] * len(linear)
    searching = list(range(len(linear)))
    for fraction in (*FRACTIONS, 0.0):
        points = [_moved(linear[i], steps[i], fraction, STARTS) for i in searching]
        lowest = _lowest_of([linear[i] for i in searching], points, [steps[i].s2 for i in searching])
        least = [heights[i] - SERVES * 2 * fraction * steps[i].gain for i in searching]
        served = []
        for i, enough, (point, predicted, height) in zip(searching, least, lowest, strict=True):
            if height < (heights[i] if (there := best[i]) is None else _height(there, steps[i].s2)):
                best[i] = linear[i].about(point, predicted)
                served += [i] if fraction and height < enough else []
        searching = [i for i in searching if i not in served]
        if not searching:
            break
    return best


def _lowest_of(
    linear: Sequence[Linearization], points: Sequence[Sequence[Point]], s2: Sequence[float]
) -> list[tuple[Point, Float[np.ndarray, "segments samples columns"], float]]:
    """For each hypothesis the best of its points, whose unknowns are one, with every segment's best start."""
    requests = []
    for lin, tried in zip(linear, points, strict=True):
        start = Start(*(np.concatenate([getattr(p.start, a) for p in tried]) for a in ("qpos", "qvel", "act")))
        requests.append(lin.problem.request(np.stack([p.z for p in tried]), start))
    predicted = simulate([(lin.problem, lin.point) for lin in linear], requests)
    return [
        _lowest(lin, tried, p.reshape(len(tried), -1, *p.shape[1:]), scale)
        for lin, tried, p, scale in zip(linear, points, predicted, s2, strict=True)
    ]


def _lowest(
    lin: Linearization,
    points: Sequence[Point],
    predicted: Float[np.ndarray, "points segments samples columns"],
    s2: float,
) -> tuple[Point, Float[np.ndarray, "segments samples columns"], float]:
    """The unknowns with each segment's best start, their prediction and height."""
    problem, count = lin.problem, lin.problem.segments.count
    r = problem.residuals(predicted.reshape(-1, *predicted.shape[2:])).reshape(len(points), count, -1)
    misfit = (problem.measurement.bend(r * problem.weight) ** 2).sum(2)
    misfit += np.stack([((tangent(problem, p.start) / problem.guess.prior_sd) ** 2).sum(1) for p in points])
    misfit[~np.isfinite(predicted).all((2, 3))] = np.inf
    which, segments, z = np.argmin(misfit, axis=0), np.arange(count), points[0].z
    start = (np.stack([getattr(p.start, a) for p in points])[which, segments] for a in ("qpos", "qvel", "act"))
    height = float(misfit.min(0).sum()) / s2 + float(z @ z)
    return Point(z, Start(*start)), predicted[which, segments], height


def summarize(lin: Linearization, free_scale: bool, end: End) -> Fit:
    """Chi2, likelihood and the covariance of z at a point."""
    gram, _, square = (x.sum(0) for x in lin.gram())
    chi2 = float(square)
    s2 = noise_scale(lin, chi2, free_scale)
    covariance = np.linalg.inv(gram / s2 + np.eye(lin.problem.size))
    return Fit(lin, covariance, s2, chi2, lin.latent.log_normalizer - 0.5 * chi2, end)
