"""Forces of unlisted shape beside a fit: on which joint, and in which variables, a free curve earns most evidence."""

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.mismatch.addition import Addition, add
from det2stoc_bayes.mismatch.effects.base import SMALL, PlacedEffect
from det2stoc_bayes.mismatch.effects.elements import Element, Typical
from det2stoc_bayes.mismatch.effects.unlisted import FORMS, UnlistedForce
from det2stoc_bayes.mismatch.put_back import put_back
from det2stoc_bayes.mismatch.response import Response
from det2stoc_bayes.mismatch.screen import Beside, Screened
from det2stoc_bayes.optimize import Fit

LENGTHS = ((0.04,), (0.08,), (0.16,), (0.35,), (1.0,))  # over which a curve bends, as shares of the variable's range
SURFACES = ((0.12, 1.5), (0.35, 0.4), (0.35, 1.5), (1.0, 0.4), (1.0, 1.5))  # and those of two variables
AMPLITUDES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # of the typical force
MARGIN = 0.04  # of the range, beyond what the fitted motion reaches


def joints(pool: Sequence[PlacedEffect]) -> list[tuple[Element, Typical]]:
    """The joints that candidates sit on, and what is typical there."""
    return list(dict.fromkeys((c.element, c.typical) for c in pool if c.effect.name == "constant_force"))


def screen_unlisted(fit: Fit, pool: Sequence[PlacedEffect], num_variables: int) -> list[Screened]:
    """The best curve on each joint of the pool for each variable, or each pair of them; most evidence first."""
    response, beside = Response(fit), Beside(fit)
    found = [
        one
        for at, typical in joints(pool)
        for form in FORMS
        if len(form.variables) == num_variables and form().fits(at)
        for one in [_best(response, beside, at, typical, form)]
        if one is not None
    ]
    return sorted(found, key=lambda s: -s.log_evidence)


def reshaped(fit: Fit) -> tuple[Fit, Screened] | None:
    """The last effect, a curve, as smooth and large as suits its own fit best; and what it stands beside there.

    The latter is no optimum: it is the fit's own linearization, with what the curve explains put back.
    """
    own = fit.problem.effects[-1]
    effect = own.effect
    assert isinstance(effect, UnlistedForce)
    bare, response = put_back(fit), Response(fit)
    found = _best(response, Beside(bare), own.element, own.typical, type(effect))
    return None if found is None else (bare, found)


def _best(
    response: Response, beside: Beside, at: Element, typical: Typical, form: type[UnlistedForce]
) -> Screened | None:
    """The curve whose smoothness and size, of a few, earn most; None where a variable stands still."""
    inside = response.joint_states(at)
    along = form().along(inside)
    reach = tuple(reach_of(x[response.real]) for x in (along if isinstance(along, tuple) else (along,)))
    if any(low == high for low, high in reach):
        return None
    effect = form(reach)
    given = {name: np.array(value) for name, value in effect.given(typical).items()}
    knots, weights = effect.parts(given, inside, np)
    columns = response.propagate(*response.forced(at.dof, _hats(knots, weights, len(effect.modes))))
    if not np.isfinite(columns).all():
        return None
    units = beside.latent.project(beside.latent.stack(columns))
    equations = Equations(beside, units.reshape(-1, units.shape[-1]))
    tried = [(e, equations.added(e.root(typical))) for e in shapes(form, reach)]
    effect, best = max(((e, a) for e, a in tried if a is not None), key=lambda t: t[1].log_evidence)
    response_to = units @ (SMALL * effect.root(typical))
    trial = effect.trials(typical)[0]
    return Screened(
        PlacedEffect(effect, at, typical),
        trial,
        best.log_evidence,
        best.gain,
        best.coefficients / SMALL,
        best.change,
        response_to,
    )


def _hats(
    knots: Int[np.ndarray, "S K points parts"], shares: Float[np.ndarray, "S K points parts"], count: int
) -> Float[np.ndarray, "S K count"]:
    """What each knot's value counts in every interval's mean force."""
    intervals = np.arange(knots[..., 0, 0].size).reshape(knots.shape[:2])[..., None, None]
    flat = np.bincount((intervals * count + knots).ravel(), shares.ravel(), intervals.size * count)
    return flat.reshape(*knots.shape[:2], count) / knots.shape[2]


def reach_of(x: Float[np.ndarray, "*points"]) -> tuple[float, float]:
    """What the motion covers, where it stays finite, and a little more; no range where it nowhere does."""
    x = x[np.isfinite(x)] if np.isfinite(x).any() else np.zeros(1)
    low, high = float(x.min()), float(x.max())
    room = MARGIN * (high - low)
    return (low - room, high + room) if high - low > 1e-9 * max(abs(low), abs(high), 1e-9) else (low, low)


def shapes(form: type[UnlistedForce], reach: tuple[tuple[float, float], ...]) -> Iterator[UnlistedForce]:
    """The same curve under priors of several sizes and lengths."""
    for lengths, amplitude in product(LENGTHS if len(reach) == 1 else SURFACES, AMPLITUDES):
        yield form(reach, lengths, amplitude)


class Equations:
    """Normal equations of a fit's unknowns and of a curve's values at its knots."""

    def __init__(self, beside: Beside, x: Float[np.ndarray, "values knots"]):
        self.beside = beside
        self.cross, self.gram, self.slope = beside.columns.T @ x, x.T @ x, x.T @ beside.error

    def added(self, root: Float[np.ndarray, "knots modes"]) -> Addition | None:
        """Closed-form evidence of values root z, z standard normal, against none."""
        cross, count = self.cross @ root, root.shape[1]
        gram = np.block([[self.beside.gram, cross], [cross.T, root.T @ self.gram @ root]])
        slope = np.concatenate([self.beside.slope, root.T @ self.slope])
        return add(self.beside.fit, gram, slope, np.ones(count), np.zeros(count, bool))
