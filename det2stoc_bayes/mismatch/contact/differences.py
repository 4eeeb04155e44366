"""Sensitivities of followed simulations by finite differences that are wide, and no wider than contact allows."""

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.linearization import follow_own
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.unknowns import Unknowns

STEPS = (0.2, 0.04, 0.008)  # prior sds to either side: the first over which predictions are smooth enough
SMOOTH = 0.7  # share of a sensitivity's square that both sides agree on
AGREE = 0.3  # relative difference of the slopes to either side beyond which a sensitivity is chaos
MOST_WIDER = 5.0  # population sds for one of the prior


def steady(up: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Slopes as far as those to either side agree: where contact is chaotic they have nothing in common."""
    size = np.abs(up) + np.abs(down)
    apart = np.divide(np.abs(up - down), size, out=np.zeros_like(size), where=size > 0)
    return 0.5 * (up + down) / (1 + (apart / AGREE) ** 4)


def columns_of(
    followed: Followed,
    z: np.ndarray,
    errors: np.ndarray | None,
    sizes: np.ndarray | None = None,
    known: np.ndarray | None = None,
    untold: Collection[int] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """Sensitivities by finite differences over given steps, or over those to whose sides they agree best.

    `errors` are those at z; where they are not known they are simulated beside the first differences. None are found
    to unknowns that are to stay `untold`.
    """
    problem = followed.problem
    columns = np.zeros((*followed.shape, problem.size))
    sizes = np.full(problem.size, np.nan) if sizes is None else sizes.copy()
    first = 0 if known is None else known.shape[-1]
    columns[..., :first] = 0.0 if known is None else known
    told, wider = {*problem.unknowns.followed(z), *untold}, _wider(problem.unknowns, z, problem.size)
    probes = [which for which in problem.probes() if which[0] >= first and which[0] not in told]
    given = [which for which in probes if np.isfinite(sizes[which[0]])]
    found, errors = _differences(followed, z, errors, given, [float(sizes[w[0]] * wider[w[0]]) for w in given])
    for which, (change, _) in zip(given, found, strict=True):
        _put(columns, which, change, followed.recording)
    probes = [which for which in probes if not np.isfinite(sizes[which[0]])]
    best = np.full(problem.size, -1.0)
    for size in STEPS:
        found, errors = _differences(followed, z, errors, probes, [float(size * wider[w[0]]) for w in probes])
        for which, (change, agreed) in zip(probes, found, strict=True):
            if agreed > best[which[0]]:
                best[which[0]], sizes[which] = agreed, size
                _put(columns, which, change, followed.recording)
        probes = [which for which in probes if best[which[0]] < SMOOTH]
    follow_own(problem.unknowns, z, columns, followed.recording)
    return columns, sizes


def _wider(unknowns: Unknowns, z: np.ndarray, size: int) -> Float[np.ndarray, " size"]:
    """How much wider each unknown is moved: own values, in sds of their population, as far as mu moves them."""
    wider = np.ones(size)
    for block in unknowns.varying:
        slope = np.median(np.abs(block.shared_slopes(z)[0]))
        wider[block.first_own : block.stop] = np.clip(slope, 1.0, MOST_WIDER) if np.isfinite(slope) else 1.0
    return wider


def _put(columns: np.ndarray, which: np.ndarray, change: np.ndarray, recording: np.ndarray) -> None:
    """Unknowns of single recordings show in their own alone."""
    if len(which) == 1:
        columns[..., which[0]] = change
        return
    for r, i in enumerate(which):
        mine = recording == r
        columns[mine, :, :, i] = change[mine]


def _differences(
    followed: Followed, z: np.ndarray, errors: np.ndarray | None, probes: Sequence[np.ndarray], sizes: Sequence[float]
) -> tuple[list[tuple[np.ndarray, float]], np.ndarray | None]:
    """Changes of the prediction for one sd of the unknowns of each probe, and the share that both sides agree on.

    Beside them the errors at z, found where there is a probe.
    """
    if not probes:
        return [], errors
    problem = followed.problem
    moved, steps = np.tile(z, (2 * len(probes), 1)), []
    for k, (which, size) in enumerate(zip(probes, sizes, strict=True)):
        steps.append(abs(problem.nudge(z, which, size)))
        moved[2 * k, which] += steps[-1]
        moved[2 * k + 1, which] -= steps[-1]
    moved = np.maximum(moved, problem.floor)
    if errors is None:
        *found, errors = followed.errors(np.vstack([moved, z]))
    else:
        found = followed.errors(moved)
    out = []
    for k, (which, step) in enumerate(zip(probes, steps, strict=True)):
        back = z[which[0]] - moved[2 * k + 1, which[0]]  # less than a step where a wall is near
        up = np.nan_to_num((errors - found[2 * k]) / step)
        down = np.nan_to_num((found[2 * k + 1] - errors) / max(back, 0.5 * step))
        if back < 0.5 * step:  # at the wall there is one side only
            out.append((up, 1.0))
            continue
        change = steady(up, down)
        whole = float(((0.5 * (up + down)) ** 2).sum())
        out.append((change, float((change**2).sum()) / whole if whole > 0 else 1.0))
    return out, errors
