"""Compare a diagnosis (diagnosis.json) with the answer of a concealed case."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from det2stoc_bayes.blind.intervals import Estimates, compare_parameters, compare_psi

Json = Mapping[str, Any]
LEAST_GAIN = 0.1  # of the true simulator's error: below it nothing is to be gained


@dataclass(frozen=True)
class EffectScore:
    """How one concealed effect was diagnosed; None where a question does not apply.

    `named`: a claim has its name and element, or an accepted equivalent's. `placed`: a claim is on its element.
    `listed`: it is among the claims or the candidates.
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

    `own`: each by its own name and element, not an accepted equivalent's, whose psi may be others (clocks that run fast
    look like less mass). `false_claim`: a mismatch is claimed and some of what is named is wrong. `psi_inside`,
    `psi_narrow`: of each psi whether its 95 % interval holds the truth, and is narrower than NARROW of it.
    `improvement` on held-out recordings is a share of what the true law gives.
    """

    truth: str
    diagnosed: str
    verdict: bool
    named: bool
    own: bool
    false_claim: bool
    effects: tuple[EffectScore, ...] = ()
    psi_inside: tuple[bool, ...] = ()
    psi_narrow: tuple[bool, ...] = ()
    improvement: float | None = None

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
    inside, narrow = compare_psi(answer.get("psi", {}), diagnosis.get("psi") or {})
    if not answer["effects"]:
        silent = verdict == "no_mismatch" and not claims
        said = "no_mismatch" if silent else labels(claims, verdict)
        alarm = verdict in ("mismatch", "inconclusive")
        return CaseScore("nothing", said, silent, silent, silent, alarm, (), inside, narrow)
    claimed = verdict == "mismatch"
    paired = pairing(answer["effects"], claims)
    effects = tuple(
        _judge(truth, claims, diagnosis.get("candidates") or [], paired.get(i) if claimed else None)
        for i, truth in enumerate(answer["effects"])
    )
    named = claimed and all(e.named for e in effects) and len(claims) == len(effects)
    own = named and all(_is(answer["effects"][i], claims[c]) for i, c in paired.items())
    strangers = len(paired) < len(claims)
    return CaseScore(
        labels(answer["effects"], ""),
        labels(claims, verdict),
        verdict == answer["verdict"],
        named,
        own,
        claimed and (strangers or not claims),
        effects,
        inside,
        narrow,
        improvement(answer, diagnosis.get("fit")),
    )


def improvement(answer: Json, fit: Json | None) -> float | None:
    """How much of the rollouts' error on held-out recordings is gone, as a share of what the true law takes away.

    None where the believed model is about as good as the truth.
    """
    before, after = heldout_errors(answer, fit)
    if before is None or before <= 1.0 + LEAST_GAIN:
        return None
    return 0.0 if after is None else (before - after) / (before - 1.0)


def heldout_errors(answer: Json, fit: Json | None) -> tuple[float | None, float | None]:
    """RMS error of held-out rollouts before and after, of columns that do not diverge before; None: it diverges.

    In units of the true simulator's own error from true states (of answers that lack that: of the noise).
    """
    if not fit:
        return None, None
    before, after = fit["rollout_rmse_before"], fit["rollout_rmse_after"]
    truth = {c: sd for c, sd in (answer.get("truth_rmse") or fit["rollout_rmse_noise"]).items() if sd}
    columns = [c for c in truth if before.get(c) is not None]
    if not columns:
        return None, None
    left = None
    if not any(after.get(c) is None for c in columns):
        left = _rms([after[c] / truth[c] for c in columns])
    return _rms([before[c] / truth[c] for c in columns]), left


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))


def _judge(truth: Json, claims: Sequence[Json], candidates: Sequence[Json], claim: int | None) -> EffectScore:
    members = members_of(truth)
    placed = any(same_element(m, given) for m in members for c in claims for given in _given(c))
    listed = any(matches(members, entry) for entry in (*claims, *candidates))
    if claim is None:
        return EffectScore(label(truth), False, placed, listed)
    right, given = matches(members, claims[claim])[0]
    estimates = compare_parameters(right.get("parameters", {}), given.get("parameters", {}), right.get("judged", {}))
    return EffectScore(label(truth), True, placed, listed, estimates, claims[claim].get("probability"))


def pairing(truths: Sequence[Json], claims: Sequence[Json]) -> dict[int, int]:
    """The largest matching of effects to claims, each claim used once; there are few of either."""

    def extend(index: int, used: frozenset[int]) -> dict[int, int]:
        if index == len(truths):
            return {}
        options = [extend(index + 1, used)]
        for c, claim in enumerate(claims):
            if c not in used and matches(members_of(truths[index]), claim):
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


def members_of(truth: Json) -> list[Json]:
    """A concealed effect and what counts as right beside it."""
    return [truth, *truth.get("accepted", [])]


def _given(entry: Json) -> list[Json]:
    """An entry and its equivalents; an equivalent without an element acts on the entry's own."""
    return [entry, *({"element": entry["element"], **other} for other in entry.get("equivalent") or [])]


def matches(members: Sequence[Json], entry: Json) -> list[tuple[Json, Json]]:
    """Pairs of a right answer and what an entry of a diagnosis says, of the same name and element."""
    pairs = [(m, g) for m in members for g in _given(entry)]
    return [(m, g) for m, g in pairs if m["name"] == g["name"] and same_element(m, g) and _same_variables(m, g)]


def _is(right: Json, claim: Json) -> bool:
    """Whether a claim itself, not an equivalent of it, is the truth itself."""
    return right["name"] == claim["name"] and same_element(right, claim)


def _same_variables(right: Json, given: Json) -> bool:
    """Whether an effect on no list is said to depend on what it depends on; a candidate need not say it."""
    found = given.get("variables") or (given.get("parameters") or {}).get("variables")
    return "variables" not in right or found is None or set(found) == set(right["variables"])
