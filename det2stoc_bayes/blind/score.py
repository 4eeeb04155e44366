"""Compare a diagnosis (diagnosis.json) with the answer of a concealed case."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from det2stoc_bayes.blind.intervals import Estimates, compare_parameters, compare_psi

Json = Mapping[str, Any]


@dataclass(frozen=True)
class EffectScore:
    """How one concealed effect was diagnosed; None where a question does not apply.

    `named`: a claim has its name and element, or an accepted equivalent's. `placed`: a claim is on its element.
    `listed`: it is among the claims or the candidates of an inconclusive diagnosis.
    """

    truth: str
    named: bool
    placed: bool
    listed: bool
    estimates: Estimates = Estimates()
    probability: float | None = None


@dataclass(frozen=True)
class CaseScore:
    """How one diagnosis did. `named`: every effect is named, and nothing else is claimed.

    `false_claim`: a mismatch is claimed and some of what is named is wrong. `psi_covered`, `psi_narrow`: shares of
    psi whose 95 % interval holds the truth, and is narrower than NARROW of it.
    """

    truth: str
    diagnosed: str
    verdict: bool
    named: bool
    false_claim: bool
    effects: tuple[EffectScore, ...] = ()
    psi_covered: float | None = None
    psi_narrow: float | None = None

    @property
    def placed(self) -> bool:
        """Whether every effect's element was found."""
        return all(e.placed for e in self.effects)

    @property
    def listed(self) -> bool:
        """Whether every effect was at least a candidate."""
        return all(e.listed for e in self.effects)


def score(answer: Json, diagnosis: Json) -> CaseScore:
    """Judge a diagnosis by the answer of its case."""
    claims, verdict = list(diagnosis.get("effects") or []), diagnosis["verdict"]
    covered, narrow = compare_psi(answer.get("psi", {}), diagnosis.get("psi") or {})
    if not answer["effects"]:
        silent = verdict == "no_mismatch" and not claims
        said = "no_mismatch" if silent else labels(claims, verdict)
        alarm = verdict in ("mismatch", "inconclusive")
        return CaseScore("nothing", said, silent, silent, alarm, (), covered, narrow)
    claimed = verdict == "mismatch"
    pairing = _pairing(answer["effects"], claims)
    effects = tuple(
        _judge(truth, claims, diagnosis.get("candidates") or [], pairing.get(i) if claimed else None)
        for i, truth in enumerate(answer["effects"])
    )
    named = claimed and all(e.named for e in effects) and len(claims) == len(effects)
    strangers = len(pairing) < len(claims)
    return CaseScore(
        labels(answer["effects"], ""),
        labels(claims, verdict),
        verdict == answer["verdict"],
        named,
        claimed and (strangers or not claims),
        effects,
        covered,
        narrow,
    )


def _judge(truth: Json, claims: Sequence[Json], candidates: Sequence[Json], claim: int | None) -> EffectScore:
    members = _members(truth)
    placed = any(same_element(m, given) for m in members for c in claims for given in _given(c))
    listed = any(_matches(members, entry) for entry in (*claims, *candidates))
    if claim is None:
        return EffectScore(label(truth), False, placed, listed)
    right, given = _matches(members, claims[claim])[0]
    estimates = compare_parameters(right.get("parameters", {}), given.get("parameters", {}), right.get("judged", {}))
    return EffectScore(label(truth), True, placed, listed, estimates, claims[claim].get("probability"))


def _pairing(truths: Sequence[Json], claims: Sequence[Json]) -> dict[int, int]:
    """The largest matching of effects to claims, each claim used once; there are few of either."""

    def extend(index: int, used: frozenset[int]) -> dict[int, int]:
        if index == len(truths):
            return {}
        options = [extend(index + 1, used)]
        for c, claim in enumerate(claims):
            if c not in used and _matches(_members(truths[index]), claim):
                options.append({index: c, **extend(index + 1, used | {c})})
        return max(reversed(options), key=len)

    return extend(0, frozenset())


def label(entry: Json) -> str:
    """name @ element."""
    return f"{entry['name']} @ {entry['element']['name']}"


def labels(entries: Sequence[Json], otherwise: str) -> str:
    """All entries' labels, or what to say where there are none."""
    return " + ".join(label(entry) for entry in entries) or otherwise


def same_element(right: Json, given: Json) -> bool:
    """Whether two entries act on the same element; the world and the simulator need no name."""
    a, b = right["element"], given["element"]
    if a["kind"] != b["kind"]:
        return False
    return a["kind"] in ("world", "simulator") or a["name"] in ("*", b["name"])


def _members(truth: Json) -> list[Json]:
    return [truth, *truth.get("accepted", [])]


def _given(entry: Json) -> list[Json]:
    """An entry and its equivalents; an equivalent without an element acts on the entry's own."""
    return [entry, *({"element": entry["element"], **other} for other in entry.get("equivalent") or [])]


def _matches(members: Sequence[Json], entry: Json) -> list[tuple[Json, Json]]:
    return [(m, g) for m in members for g in _given(entry) if m["name"] == g["name"] and same_element(m, g)]
