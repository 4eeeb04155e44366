"""Open-loop predictions of short stretches, from states that an observer estimates of the samples before."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.segments import Segments, from_pieces

LENGTH = 20  # samples that are predicted beyond a start
WORSE, STAYS = 1.2, 0.3  # times the error of a column, and share of all beyond noise: what contradicts an explanation


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Stretches one after the other, and what is foretold of them."""

    segments: Segments
    predicted: Float[np.ndarray, "stretches samples columns"]
    errors: Float[np.ndarray, "stretches samples columns"]

    @property
    def horizon(self) -> float:
        """Seconds that a stretch lasts."""
        return float(np.median(self.segments.time[:, -1] - self.segments.time[:, 0]))

    def rmse(self) -> Float[np.ndarray, " columns"]:
        """Over all samples beyond the starts."""
        error = self.errors[:, 1:]
        seen = np.isfinite(error)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt((np.where(seen, error, 0.0) ** 2).sum((0, 1)) / seen.sum((0, 1)))

    def paths(self) -> dict[str, Float[np.ndarray, "samples columns"]]:
        """What is foretold of each sample of each recording, NaN where nothing is."""
        segments = self.segments
        out = {r.name: np.full((len(r.time), len(segments.columns)), np.nan) for r in segments.recordings}
        for s, path in enumerate(self.predicted):
            begin, length = int(segments.first[s]), int(segments.lengths[s])
            out[segments.recordings[segments.recording[s]].name][begin : begin + length] = path[:length]
        return out


def rollouts(fit: ContactFit) -> Rollouts:
    """Of all recordings of a fit."""
    followed, problem = fit.followed, fit.problem
    whole, path = problem.segments, followed.path(fit.z)
    pieces, rows, begins = [], [], []
    for s, length in enumerate(whole.lengths):
        for b in range(0, max(int(length) - 1, 1), LENGTH):
            pieces.append((int(whole.recording[s]), b, min(b + LENGTH + 1, int(length))))
            rows.append(s)
            begins.append(b)
    start = Start(*(a[rows, begins] for a in (path.qpos, path.qvel, path.act)))
    there = problem.on(from_pieces(whole.recordings, pieces, whole.columns))
    predicted = there.simulator.rollout(there.request(fit.z[None], start))
    errors = there.residuals(predicted).reshape(predicted.shape)
    return Rollouts(there.segments, predicted, np.where(there.segments.observed, errors, np.nan))


def told_worse(before: ContactFit, after: ContactFit) -> tuple[str, ...]:
    """Columns that an explanation foretells worse over stretches, where it leaves much of the error beyond noise.

    Innovations forgive what is wrong at every sample; over stretches a wrong law adds up. Columns that are not heard
    rattle, and differ by chance.
    """
    problem, heard = before.problem, before.followed.heard
    rmse = np.stack([rollouts(fit).rmse() for fit in (before, after)])
    rmse = rmse if heard is None else np.where(heard, rmse, np.nan)
    first, last = np.maximum((rmse / problem.noise) ** 2 - 1, 0.0)
    if not np.nansum(last) > STAYS * np.nansum(first):
        return ()
    return tuple(np.array(problem.segments.columns)[rmse[1] > WORSE * rmse[0]].tolist())
