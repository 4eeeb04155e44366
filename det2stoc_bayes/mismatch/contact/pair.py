"""A hypothesis on the recordings that are fitted and on those held out: how it is fitted, and added to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.mismatch.contact.fit import SETTLED, ContactFit, at, fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.mimic import mimicking
from det2stoc_bayes.mismatch.contact.regions import bordered
from det2stoc_bayes.mismatch.contact.scales import Scales
from det2stoc_bayes.mismatch.contact.screen import Promise
from det2stoc_bayes.mismatch.contact.turned import best_turned
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import log_det

MEMORIES = (3.0, 6.0, 12.0, 25.0, 50.0, 200.0)  # samples
MOST_WORSE = 2  # memories
SKETCH = 3  # iterations of what was screened
OF_LUCK = 0.1  # of the nats that fits of one hypothesis differ by: a step that gains less is the last
WILD = 10.0  # prior sds of an effect beyond which no fit begins
OWN = (-2.0, -1.0, 0.0, 1.0, 2.0)  # sds of a population at which a recording's own value is looked for
FAR = 1.5  # prior sds of some psi beyond which what is missing has led it there, and a small step of it does nothing


@dataclass(frozen=True, eq=False)
class Pair:
    """A hypothesis on the recordings that are fitted and, at the same unknowns, on those held out."""

    fit: ContactFit
    held: ContactFit

    @cached_property
    def remembering(self) -> dict[float, "Pair"]:
        """Refits with other memories that are known."""
        return {}

    @property
    def placed(self) -> PlacedEffect:
        """The effect that was added last."""
        return self.fit.problem.effects[-1]

    @property
    def owners(self) -> Int[np.ndarray, " blocks"]:
        """A number for the recording of every block, in the order of `losses`; held-out recordings are others."""
        first = len(self.fit.problem.segments.recordings)
        return np.concatenate([self.fit.followed.recording, first + self.held.followed.recording])

    @property
    def losses(self) -> Float[np.ndarray, " blocks"]:
        """-log likelihood of every block, held-out ones last."""
        return np.concatenate([self.fit.losses, self.held.losses])

    @cached_property
    def height(self) -> float:
        """-log evidence by Laplace's approximation, held-out recordings told at the fit; up to a constant."""
        z = self.fit.z
        return float(self.losses.sum() + 0.5 * z @ z) + 0.5 * log_det(self.fit.gram)

    def gain(self, base: "Pair") -> float:
        """Nats by which it is ahead of another hypothesis."""
        return base.height - self.height


def paired(fit: ContactFit, held: Followed) -> Pair:
    """A fit, and what it says of held-out recordings: unknowns of single recordings are fitted to each of these."""
    mine = fit.problem
    options = {"timestep": mine.timestep, "integrator": mine.integrator}
    problem = replace(held.problem, effects=mine.effects, spreads=mine.spreads, **options)
    z = mine.carry(fit.z, problem)
    there = held.with_problem(problem).led_as(fit.followed)
    own = set(problem.unknowns.owned.tolist())
    if not own:
        return Pair(fit, at(there, z, fit.scales))
    shared = [i for i in range(problem.size) if i not in own]
    found = fit_followed(there, with_own(there, z, fit.scales), untold=shared, iterations=SKETCH)
    return Pair(fit, replace(found, scales=fit.scales))


def with_own(followed: Followed, z: Float[np.ndarray, " size"], scales: Scales) -> Float[np.ndarray, " size"]:
    """These unknowns, each recording's own value where it is or where a coarse look tells that recording better."""
    for own in followed.problem.unknowns.own:
        values = np.stack([z[own], *(np.full(len(own), sds) for sds in OWN)])
        tried = np.tile(z, (len(values), 1))
        tried[:, own] = values
        told = np.stack([scales.losses(e) for e in followed.errors(tried)])
        by_recording = told.reshape(len(values), len(own), -1).sum(-1) + 0.5 * values**2
        z = z.copy()
        z[own] = values[by_recording.argmin(0), np.arange(len(own))]
    return z


def climbed(fit: ContactFit) -> ContactFit:
    """The same hypothesis with the memory by which it foretells recordings best; what is missing adds up over more."""
    while (longer := longer_by_one(fit)) is not None and longer.loss <= fit.loss:
        fit = longer
    return fit


def longer_by_one(fit: ContactFit, settled: float = SETTLED) -> ContactFit | None:
    """The same hypothesis fitted with that longer memory which serves it best as it is, or else with the next one.

    None where it has the longest. Memories beyond MOST_WORSE in a row that serve it less than any before are not
    looked at, and what is far behind is not fitted to the end.
    """
    tried = remembering_each(fit, [m for m in MEMORIES if m > fit.followed.memory], fit.loss)
    if not tried:
        return None
    best = min(tried, key=lambda f: f.loss)
    start = best if best.loss < fit.loss else tried[0]
    return fit_followed(start.followed, start.z, like=fit, settled=settled, needed=start.loss - fit.loss)


def remembering_each(fit: ContactFit, memories: Sequence[float], least: float = np.inf) -> list[ContactFit]:
    """The same unknowns with each memory, up to MOST_WORSE in a row that serve them less than any before."""
    tried, worse = list[ContactFit](), 0
    for memory in memories:
        tried.append(at(fit.followed.remembering(memory), fit.z))
        worse, least = (worse + 1 if tried[-1].loss > least else 0), min(least, tried[-1].loss)
        if worse >= MOST_WORSE:
            break
    return tried


def nearer(fit: ContactFit) -> ContactFit:
    """The same hypothesis where no psi is FAR: the ground on which others are looked for."""
    psi = np.arange(len(fit.z)) < fit.problem.num_psi
    z = np.where(psi, np.clip(fit.z, -FAR, FAR), fit.z)
    return fit if (z == fit.z).all() else at(fit.followed, z)


def sketched(base: ContactFit, promise: Promise, iterations: int = SKETCH) -> ContactFit:
    """The hypothesis with a screened addition after a few steps."""
    more = base.problem.with_effects((*base.problem.effects, promise.placed))
    new = np.clip(np.nan_to_num(promise.placed.effect.to_normal(promise.values, promise.placed.typical)), -WILD, WILD)
    ways = [np.concatenate([base.z + a * promise.change, b * new]) for a, b in ((1.0, 1.0), (0.0, 1.0), (0.3, 0.3))]
    first, *others = (np.maximum(way, more.floor) for way in ways)
    return fit_followed(base.followed.with_problem(more), first, others=others, iterations=iterations, like=base)


def on_all(sketch: ContactFit, base: ContactFit) -> ContactFit:
    """What was sketched on some of a base's recordings, after a few steps on all of them."""
    followed = base.followed.with_problem(base.problem.with_effects(sketch.problem.effects))
    return fit_followed(followed, sketch.z, iterations=SKETCH, like=sketch)


def finished(fit: ContactFit, held: Followed, luck: float) -> Pair:
    """What was begun, fitted until steps gain next to nothing beside what is luck."""
    settled = next_to_nothing(luck)
    done = fit_followed(fit.followed, fit.z, like=fit, settled=settled)
    return best_bordered(paired(best_turned(done, settled), held))


def next_to_nothing(luck: float) -> float:
    """Nats by which a step is the last one, where fits of one hypothesis differ by so many."""
    return max(SETTLED, OF_LUCK * luck)


def best_bordered(pair: Pair, *, anew: bool = True) -> Pair:
    """The same hypothesis, the region of its last effect, if it has one, where all recordings are told best.

    Looked for everywhere, or else about where it is.
    """
    other = bordered(pair.fit, anew=anew)
    return pair if other is pair.fit else min((pair, paired(other, pair.held.followed)), key=lambda p: p.height)


def remembered(pair: Pair) -> Pair:
    """The same hypothesis `climbed`."""
    best = climbed(pair.fit)
    return pair if best is pair.fit else paired(best, pair.held.followed)


def remembering_more(pair: Pair, luck: float) -> Pair | None:
    """The same hypothesis with a longer memory; None where that does not serve it."""
    longer = longer_by_one(pair.fit, next_to_nothing(luck))
    if longer is None:
        return None
    more = best_bordered(paired(longer, pair.held.followed), anew=False)
    if more.height <= pair.height and more.fit.loss > pair.fit.loss:  # given up for recordings that are fitted alone
        whole = fit_followed(more.fit.followed, more.fit.z, like=more.fit, settled=next_to_nothing(luck))
        return paired(whole, pair.held.followed)
    return more if more.fit.loss <= pair.fit.loss else None


def with_memory(pair: Pair, memory: float) -> Pair:
    """The same hypothesis refitted with a given memory."""
    fit, known = pair.fit, pair.remembering
    if memory == fit.followed.memory:
        return pair
    if memory not in known:
        again = fit_followed(fit.followed.remembering(memory), fit.z, iterations=SKETCH, like=fit)
        known[memory] = paired(again, pair.held.followed)
    return known[memory]


def caught_up(rival: Pair, leader: Pair) -> Pair:
    """A rival fitted with the leader's memory, from its own effects or from where it predicts as the leader does."""
    fit, shared = rival.fit, leader.fit.problem.size - leader.placed.size
    followed = fit.followed.remembering(leader.fit.followed.memory)
    there = np.concatenate([leader.fit.z[:shared], fit.z[shared:]])
    alike = mimicking(at(followed, there), leader.fit).z
    return paired(fit_followed(followed, there, others=[alike, fit.z], like=fit), rival.held.followed)


def without_last(pair: Pair, memory: float) -> ContactFit:
    """The same psi without the effect that was added last, with another memory."""
    problem = pair.fit.problem.with_effects(pair.fit.problem.effects[:-1])
    z = pair.fit.z[: -pair.placed.size]
    return at(pair.fit.followed.with_problem(problem).remembering(memory), z)
