"""Stated probabilities beside what was true: are they as often right as they say?"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from det2stoc_bayes.blind.score import matches, members_of, pairing

Json = Mapping[str, Any]
LEAST = 1e-4  # a probability below it, or as near to 1, is taken as that: no log score is infinite
NUM_SIMULATED = 10_000
BINS = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)


@dataclass(frozen=True)
class Group:
    """Probabilities of explanations that exclude one another; `true` is the index of the right one, None: another."""

    stated: tuple[float, ...]
    true: int | None


@dataclass(frozen=True)
class Bin:
    """Statements of about one probability: how many, the mean stated, the share that is true with its 95 % interval."""

    count: int
    stated: float
    true: float
    low: float
    high: float


@dataclass(frozen=True)
class Reliability:
    """How stated probabilities did, and the p-value of their being right.

    `log_score`: mean over groups [nat]; `expected`: what it would be if they were right; `brier`: mean squared error of
    single statements.
    """

    num_statements: int
    num_groups: int
    log_score: float
    expected: float
    p_value: float
    brier: float
    bins: tuple[Bin, ...]


def groups(answer: Json, diagnosis: Json) -> list[Group]:
    """One group for each claim and its alternatives, and one of the candidates: of all, or beside what is claimed."""
    truths = [members_of(truth) for truth in answer["effects"]]
    claims, found = diagnosis.get("effects") or [], []
    paired = pairing(answer["effects"], claims)
    for c, claim in enumerate(claims):
        left = [truth for i, truth in enumerate(truths) if paired.get(i) in (None, c)]
        found.append(_group([claim, *(claim.get("alternatives") or [])], left))
    if candidates := diagnosis.get("candidates") or []:
        found.append(_group(candidates, [truth for i, truth in enumerate(truths) if paired.get(i) is None]))
    return found


def _group(entries: Sequence[Json], truths: Sequence[list[Json]]) -> Group:
    """Entries that are right are one explanation, for nothing tells them apart."""
    right = [i for i, entry in enumerate(entries) if _right(entry, truths)]
    stated = np.array([entry["probability"] for entry in entries], float)
    stated /= max(stated.sum(), 1.0)
    if not right:
        return Group(tuple(stated.tolist()), None)
    others = [i for i in range(len(entries)) if i not in right]
    return Group((float(stated[right].sum()), *stated[others].tolist()), 0)


def _right(entry: Json, truths: Sequence[list[Json]]) -> bool:
    if entry.get("element") is None:  # that nothing is missing
        return not truths
    return any(matches(members, entry) for members in truths)


def reliability(found: Sequence[Group]) -> Reliability | None:
    """Whether probabilities hold what they say; None without any.

    The test is chi-squared over BINS of what was true beside what was stated (Hosmer and Lemeshow 1980), against
    outcomes simulated under the stated probabilities, since statements of a group hang together.
    """
    if not found:
        return None
    random, every, rows = np.random.default_rng(0), [_categories(g) for g in found], np.arange(NUM_SIMULATED)
    expected, variance, true = np.zeros((3, len(BINS)))  # the last one is of what is not stated
    simulated, scores = np.zeros((NUM_SIMULATED, len(BINS))), np.zeros(NUM_SIMULATED)
    for group, p in zip(found, every, strict=True):
        where = np.append(_bin(np.array(group.stated)), len(BINS) - 1)
        np.add.at(expected, where, p)
        np.add.at(variance, where, p * (1.0 - p))
        true[where[-1 if group.true is None else group.true]] += 1
        drawn = random.choice(p.size, NUM_SIMULATED, p=p)
        simulated[rows, where[drawn]] += 1
        scores += np.log(p)[drawn]
    used = np.flatnonzero(variance[:-1])
    chi2 = [np.sum(np.square(n[..., used] - expected[used]) / variance[used], -1) for n in (true, simulated)]
    score = sum(math.log(p[-1 if g.true is None else g.true]) for g, p in zip(found, every, strict=True))
    stated = np.array([p for g in found for p in g.stated])
    right = np.array([i == g.true for g in found for i in range(len(g.stated))], float)
    return Reliability(
        stated.size,
        len(found),
        score / len(found),
        float(np.mean(scores)) / len(found),
        float((1 + np.sum(chi2[1] >= chi2[0] - 1e-9)) / (1 + NUM_SIMULATED)),
        float(np.mean((stated - right) ** 2)),
        tuple(_bins(stated, right)),
    )


def _categories(group: Group) -> np.ndarray:
    """Probabilities of all explanations and of any other, none of them 0."""
    p = np.array([*group.stated, max(1.0 - sum(group.stated), 0.0)])
    p = np.maximum(p, LEAST)
    return p / p.sum()


def _bin(stated: np.ndarray) -> np.ndarray:
    """The place of each probability among BINS."""
    return np.clip(np.searchsorted(BINS, stated, side="right") - 1, 0, len(BINS) - 2)


def _bins(stated: np.ndarray, true: np.ndarray) -> list[Bin]:
    where, found = _bin(stated), []
    for b in np.unique(where):
        mine = where == b
        count, hits = int(mine.sum()), int(true[mine].sum())
        low, high = stats.binomtest(hits, count).proportion_ci()
        found.append(Bin(count, float(stated[mine].mean()), hits / count, float(low), float(high)))
    return found
