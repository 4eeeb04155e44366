"""What errors a right model would leave: those of fits to recordings that a hypothesis itself has made."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.mismatch.contact.fit import ContactFit, fit_followed
from det2stoc_bayes.mismatch.contact.pair import Pair
from det2stoc_bayes.mismatch.contact.replicas import replicated
from det2stoc_bayes.mismatch.contact.scales import Scales, scatter
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side

NUM_REPLICAS = 2
FARTHEST = 4.0  # scales beyond which an error counts no more: one block that went the other way says little
SURELY = 2.0  # standard errors
LEAST_BLOCKS = 8  # that are held out, or nothing is decided by them alone


@dataclass(frozen=True, eq=False)
class Yardstick:
    """Fits to a hypothesis' own recordings, the scales of their errors, and their mean square in these."""

    replicas: tuple[ContactFit, ...]
    reference: Scales
    level: float
    evaluations: int  # simulations of all fitted recordings that the fits took

    def of(self, pair: Pair) -> float:
        """Mean squared error of held-out blocks, of all where too few are held out."""
        return float(self._blocks(pair).mean())

    def left(self, before: float, after: float) -> float:
        """Share of an excess error that is left where that mean falls from one to the other; 0 where none exceeds."""
        excess = before - self.level
        return float(np.clip((after - self.level) / max(excess, 1e-9), 0.0, 1.0)) if excess > 0 else 0.0

    def most_gained(self, before: Pair, after: Pair) -> float:
        """Share of the level that one hypothesis may leave less than another, at most: SURELY standard errors more.

        By all blocks: on those that were fitted an addition leaves less anyway, and what is little there is little.
        """
        fell = self._all(before) - self._all(after)
        return (float(fell.mean()) + SURELY * standard_error(fell, _owners(after))) / self.level

    def along(self, pair: Pair) -> "Yardstick":
        """One by what a hypothesis itself leaves, with whatever memory it has."""
        own = replace(self, reference=pair.fit.scales)
        return replace(own, level=float(own._all(pair).mean()))

    def uncertain(self, pair: Pair) -> float:
        """1 standard error of the mean, over blocks."""
        blocks = self._blocks(pair)
        return standard_error(blocks, _owners(pair)[: len(blocks)])

    def _blocks(self, pair: Pair) -> Float[np.ndarray, " blocks"]:
        held = squares(pair.held.errors, self.reference)
        return held if len(held) >= LEAST_BLOCKS else self._all(pair)

    def _all(self, pair: Pair) -> Float[np.ndarray, " blocks"]:
        return np.concatenate([squares(one.errors, self.reference) for one in (pair.held, pair.fit)])


def _owners(pair: Pair) -> Int[np.ndarray, " blocks"]:
    """The recording of every block, held-out ones first."""
    return np.roll(pair.owners, pair.held.followed.count)


def standard_error(blocks: Float[np.ndarray, " blocks"], recording: Int[np.ndarray, " blocks"]) -> float:
    """Of the mean over blocks, of which neighbours are correlated: no smaller than if they were not."""
    centred = (blocks - blocks.mean())[:, None]
    total = max(float(scatter(centred, recording)[0, 0]), float((centred**2).sum()))
    return float(np.sqrt(total)) / len(blocks)


def yardstick(fit: ContactFit, seed: int) -> Yardstick:
    """That of a hypothesis at its most likely unknowns."""
    counter = fit.problem.simulator.counter
    begun = counter.simulations
    made = [replicated(fit, np.random.default_rng([seed, k])) for k in range(NUM_REPLICAS)]
    replicas = tuple(side_by_side(fit.problem, lambda f: fit_followed(f, fit.z, iterations=3, like=fit), made))
    pooled = np.sqrt(np.mean([r.scales.values**2 for r in replicas], axis=0))
    reference = Scales(np.maximum(pooled, 1e-300))
    level = float(np.mean([squares(r.errors, reference).mean() for r in replicas]))
    evaluations = (counter.simulations - begun) // max(fit.problem.segments.count, 1)
    return Yardstick(replicas, reference, level, evaluations)


def squares(errors: Float[np.ndarray, "blocks samples columns"], reference: Scales) -> Float[np.ndarray, " blocks"]:
    """Mean squared error of each block in scales that a right model leaves, large ones cut off."""
    u = np.minimum((errors / reference.values) ** 2, FARTHEST**2)
    there = np.isfinite(errors)
    return np.where(there, u, 0.0).sum((1, 2)) / np.maximum(there.sum((1, 2)), 1)
