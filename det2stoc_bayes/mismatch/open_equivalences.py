"""Which effects a study's recordings could not tell apart from each other, or from psi, whatever they may show."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.changes import changes
from det2stoc_bayes.mismatch.classes import SIGMAS
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.optimize import Fit

MOST_TRIALS = 12  # of an effect: one with more is a family of shapes
NULL = 1e-4  # of an effect's largest column: a combination that changes less is none


@dataclass(frozen=True)
class OpenEquivalences:
    """Groups of effects that predict alike, simplest first, and effects that psi predicts, too."""

    groups: tuple[tuple[PlacedEffect, ...], ...]
    absorbed: tuple[PlacedEffect, ...]


def open_equivalences(
    fit: Fit, pool: Sequence[PlacedEffect], advance: Callable[[int], None] = lambda n: None
) -> OpenEquivalences:
    """To first order about a fit, for effects that change the recordings as much as the noise does."""
    few = [p for p in pool if len(p.effect.trials(p.typical)) <= MOST_TRIALS]
    advance(len(pool) - len(few))
    observed = int((fit.problem.weight > 0).sum())
    slack = SIGMAS**2 / observed  # share of a squared change as large as the noise that nothing could show
    bases: dict[PlacedEffect, list[np.ndarray]] = {}
    for placed, _, columns in changes(fit, few, advance):
        basis = _beyond_psi(fit, columns, slack)
        if basis is not None:
            bases.setdefault(placed, []).append(basis)
    shown = {p: [b for b in found if b.shape[1]] for p, found in bases.items()}
    hidden = tuple(p for p, found in shown.items() if not found)
    return OpenEquivalences(_groups({p: found for p, found in shown.items() if found}, slack), hidden)


def _beyond_psi(fit: Fit, columns: np.ndarray, slack: float) -> Float[np.ndarray, "values rank"] | None:
    """Directions that neither initial states nor psi take up; None for a trial that diverges or changes nothing."""
    if not np.isfinite(columns).all():
        return None
    lin = fit.linear
    x = lin.latent.project(lin.latent.stack(columns))
    x = x.reshape(-1, x.shape[-1])
    vectors, sizes, _ = np.linalg.svd(x, full_matrices=False)
    x = vectors[:, sizes > NULL * sizes[0]] if sizes[0] > 0 else x[:, :0]
    if not x.shape[1]:
        return None
    j = lin.latent.project(lin.columns).reshape(len(x), -1)
    left = x - j @ np.linalg.lstsq(j, x, rcond=None)[0]
    vectors, sizes, _ = np.linalg.svd(left, full_matrices=False)
    return vectors[:, sizes**2 > slack]


def _groups(bases: Mapping[PlacedEffect, Sequence[np.ndarray]], slack: float) -> tuple[tuple[PlacedEffect, ...], ...]:
    """Effects each of whose trials is one of the other's; each joins the first group all of whose it is alike to."""
    groups: list[list[PlacedEffect]] = []
    for p in sorted(bases, key=lambda p: (p.size, p.effect.complexity, p.label)):
        own = next((g for g in groups if all(_alike(bases[p], bases[other], slack) for other in g)), None)
        if own is None:
            groups.append([p])
        else:
            own.append(p)
    return tuple(tuple(g) for g in groups if len(g) > 1)


def _alike(a: Sequence[np.ndarray], b: Sequence[np.ndarray], slack: float) -> bool:
    match = np.array([[_same(x, y, slack) for y in b] for x in a])
    return bool(match.any(0).all() and match.any(1).all())


def _same(a: np.ndarray, b: np.ndarray, slack: float) -> bool:
    """Whether two orthonormal bases span the same directions, but for what nothing could show."""
    if a.shape != b.shape:
        return False
    return bool(np.linalg.svd(a.T @ b, compute_uv=False).min() ** 2 > 1 - slack)
