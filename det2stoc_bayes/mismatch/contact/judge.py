"""From rounds of additions to a verdict on a study with contact."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.conflict import strained
from det2stoc_bayes.mismatch.contact.chances import alike, chances
from det2stoc_bayes.mismatch.contact.converged import no_surer_than_steps
from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.pair import MEMORIES, Pair, paired, with_memory
from det2stoc_bayes.mismatch.contact.rollouts import told_worse
from det2stoc_bayes.mismatch.contact.scales import certainty
from det2stoc_bayes.mismatch.contact.search import Round
from det2stoc_bayes.mismatch.contact.top import topped
from det2stoc_bayes.mismatch.contact.yardstick import SURELY, Yardstick, yardstick
from det2stoc_bayes.mismatch.finding import SURE
from det2stoc_bayes.mismatch.shares import NEGLIGIBLE
from det2stoc_bayes.mismatch.undecided import unmoved

MOST_ODDS = 50.0  # log; beyond them the leader has no chance anyway
MOST_LEFT = 0.5  # of the excess error that a named effect may leave unexplained


@dataclass(frozen=True, eq=False)
class Class:
    """Additions that predict alike, the one with the fewest parameters first, and their chance together."""

    members: tuple[Pair, ...]
    chance: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """What is said of a study, and what it rests on."""

    verdict: str
    before: Pair
    after: Pair
    places: tuple[tuple[Class, ...], ...]  # for each effect of `after`, what could stand there
    explains: tuple[float, ...]
    unexplained: float
    excess: float  # mean squared held-out error beyond what the model itself would leave, over the latter
    rod: Yardstick
    rounds: tuple[Round, ...]
    negligible: tuple[tuple[Pair, float], ...] = ()
    open_place: tuple[Class, ...] = ()  # what could stand beside the effects named, none of it surely
    strained: tuple[str, ...] = ()  # psi that lie far out in their priors beside the explanation
    told_worse: tuple[str, ...] = ()  # columns of held-out recordings that contradict the explanation

    @property
    def shown(self) -> Pair:
        """Nothing is added that could not be named."""
        return self.after if self.verdict == "mismatch" else self.before

    @property
    def exceeds(self) -> bool:
        """Whether the believed model surely leaves more than it would on recordings of its own."""
        return self.excess * self.rod.level > SURELY * self.rod.uncertain(self.before)

    @property
    def finer(self) -> int:
        """How many times as short as the model's own the steps are by which before and after are told."""
        problem = self.before.fit.problem
        step = problem.simulator.model.opt.timestep
        return round(step / (problem.timestep or step))


def judged(before: Pair, rounds: list[Round], seed: int, final: Pair, rod: Yardstick) -> Verdict:
    """Names the additions that recordings which were not fitted ask for, and that nothing else could stand for."""
    taken = [r for r in rounds if r.taken is not None]
    # A short memory forgives what is missing: all are led as the last one is.
    chain = [before, *(r.base for r in taken[1:]), *([final] if taken else [])]
    led = [with_memory(p, final.fit.followed.memory) for p in chain]
    start, *rest = map(rod.of, led)
    # What a right model leaves scatters by up to a quarter from one set of its own recordings to the next: on these it
    # leaves no more than the explanation does.
    excess = start - min(rod.level, *rest, start)
    explains = tuple(float(np.clip(-s / max(excess, 1e-9), -1.0, 1.0)) for s in np.diff([start, *rest]))
    last = taken[-1].taken if taken else None
    if last is not None and len(taken) > 1 and explains[-1] < NEGLIGIBLE:  # the others stand without it
        others = _without(before, rounds, taken[-1], seed)
        return replace(others, negligible=(*others.negligible, (last, max(explains[-1], 0.0))))
    left = rod.left(start, rod.of(final))
    random = np.random.default_rng(seed)
    places = tuple(classes(r, random) for r in taken)
    common = {"rounds": tuple(rounds), "rod": rod, "excess": excess / rod.level, "unexplained": left}
    small = not taken or sum(explains) < NEGLIGIBLE or surely_little(before, final, rod)
    if small:
        out = tuple((r.taken, e) for r, e in zip(taken, explains, strict=True) if r.taken is not None)
        shown = topped_pair(before, seed) if taken else before
        return Verdict("no_mismatch", shown, after=shown, places=(), explains=(), negligible=out, **common)
    # An effect beside which psi strains at its prior may stand for another.
    strain = tuple(strained(final.fit.problem, final.fit.z, np.sqrt(np.diag(final.fit.covariance))))
    worse = told_worse(before.held, final.held)
    sure = all(p[0].chance >= SURE for p in places) and left < MOST_LEFT and not strain and not worse
    verdict = "mismatch" if sure else "inconclusive"
    if len(taken) > 1 and places[-1][0].chance < SURE <= min(p[0].chance for p in places[:-1]):
        others = _without(before, rounds, taken[-1], seed)
        told = others.after.fit
        if others.verdict == "mismatch" and unmoved(told.z, told.covariance, final.fit.z[: len(told.z)]):
            return replace(others, open_place=places[-1])
    shown = before if sure else topped_pair(before, seed)
    common |= {"strained": strain, "told_worse": worse}
    return Verdict(verdict, shown, after=final, places=places, explains=explains, **common)


def surely_little(before: Pair, final: Pair, rod: Yardstick) -> bool:
    """Whether an explanation surely takes next to nothing off, with its memory and the next, which forgives less."""
    memory = final.fit.followed.memory
    if rod.most_gained(with_memory(before, memory), final) >= NEGLIGIBLE:
        return False
    longer = next((m for m in MEMORIES if m > memory), None)
    if longer is None:
        return True
    plain, told = (with_memory(p, longer) for p in (before, final))
    return rod.along(told).most_gained(plain, told) < NEGLIGIBLE


def _without(before: Pair, rounds: list[Round], last: Round, seed: int) -> Verdict:
    """The verdict of what was taken before the last addition."""
    shorter = topped_pair(last.base, seed)
    return judged(before, [r for r in rounds if r is not last], seed, shorter, yardstick(shorter.fit, seed))


def topped_pair(pair: Pair, seed: int) -> Pair:
    """A hypothesis at the top of its likelihood."""
    return paired(no_surer_than_steps(topped(pair.fit, np.random.default_rng([seed, 11]))), pair.held.followed)


def classes(one: Round, random: np.random.Generator) -> tuple[Class, ...]:
    """What could stand in a place, in classes that no sample tells apart, most probable first; the one taken leads.

    Rivals that likelihood does not tell from the likeliest have their odds against its class.
    """
    odds = {r.pair.placed: float(np.exp(min(r.log_odds, MOST_ODDS))) for r in one.rivals}
    leader = one.leader or one.taken
    told = [p for p in one.refined if p.placed not in odds]
    chance = dict(zip((p.placed for p in told), chances(told, random, one.luck), strict=True))
    ranked = sorted(told, key=lambda p: -chance[p.placed])
    ranked += sorted((r.pair for r in one.rivals), key=lambda p: -odds[p.placed])
    groups: list[list[Pair]] = []
    while ranked:
        mine = [p for p in ranked if p is ranked[0] or bool(alike(p, ranked[0], one.luck))]
        ranked = [p for p in ranked if p not in mine]
        groups.append(mine)
    each = np.array([sum(chance.get(p.placed, 0.0) for p in mine) for mine in groups])
    lead = sum(c for c, mine in zip(each, groups, strict=True) if leader in mine)
    each = np.maximum(each, [lead * max(odds.get(p.placed, 0.0) for p in mine) for mine in groups])
    found = [Class(_simplest(mine), c) for mine, c in zip(groups, (each / each.sum()).tolist(), strict=True)]
    found.sort(key=lambda c: (one.taken not in c.members, -c.chance))
    return tuple(found)


def _simplest(pairs: list[Pair]) -> tuple[Pair, ...]:
    """Those with the fewest parameters, in the order of their complexity."""
    fewest = min(p.placed.size for p in pairs)
    return tuple(sorted((p for p in pairs if p.placed.size == fewest), key=lambda p: p.placed.effect.complexity))


def worst_column(verdict: Verdict) -> tuple[str, float]:
    """The column whose error most exceeds what the model itself would leave, and by how many times in variance."""
    final = verdict.shown.fit
    told = np.isfinite(final.scales.values) & np.isfinite(verdict.rod.reference.values)
    ratio = np.where(told, final.scales.values, 1.0) / np.where(told, verdict.rod.reference.values, 1.0)
    j = int(np.where(told, ratio, 0.0).argmax())
    return final.problem.segments.columns[j], float(ratio[j] ** 2)


def log10_bayes(before: Pair, after: Pair) -> float:
    """Gain in log likelihood, what scatters over blocks taken off."""
    gains = before.losses - after.losses
    z = certainty(gains, before.owners)
    return float(min(0.5 * z * abs(z), gains.sum()) / np.log(10)) if z > 0 else 0.0


def corrected(fit: ContactFit, replicas: tuple[ContactFit, ...]) -> list[ContactFit]:
    """The replicas that are of this very hypothesis, by whose scatter and bias its covariance is corrected."""
    return [r for r in replicas if r.problem.effects == fit.problem.effects]


def covariance(fit: ContactFit, replicas: tuple[ContactFit, ...]) -> Float[np.ndarray, "size size"]:
    """Of the unknowns; where replicas of this very fit show a bias, that is part of it."""
    apart = [r.z - fit.z for r in corrected(fit, replicas)]
    if not apart:
        return 1.5 * fit.covariance
    bias = np.mean(apart, axis=0)
    return fit.covariance * (1 + 1 / len(apart)) + np.outer(bias, bias)
