"""Which cases a proof has: kinds of cases, each case drawn from the seed, its kind and its number alone."""

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from det2stoc_bayes.blind.conceal import ConcealedCase, make_case
from det2stoc_bayes.blind.laws import UNLISTED
from det2stoc_bayes.blind.systems import SMOOTH, SYSTEMS
from det2stoc_bayes.blind.variants import VARIANTS, possible

TOUCHING = tuple(name for name, system in SYSTEMS.items() if system.touching)
MOST_VARIANTS = 2  # at once
MOST_DRAWS = 100
NOTHING: Mapping[str, Any] = MappingProxyType({})
SHORT = MappingProxyType({"control": True, "num_recordings": 3, "num_samples": 60})


@dataclass(frozen=True)
class Kind:
    """What cases of a kind are: arguments of make_case, the systems and variants to draw from.

    `number` enters the seed, so that it never changes; `named`: it conceals what is asked for by name, in turn.
    """

    number: int
    options: Mapping[str, Any] = field(default_factory=lambda: NOTHING)
    systems: tuple[str, ...] = SMOOTH
    variants: tuple[str, ...] = tuple(VARIANTS)
    named: bool = False


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "effect": Kind(0, named=True),
        "pair": Kind(1, MappingProxyType({"count": 2})),
        "control": Kind(2, MappingProxyType({"control": True})),
        "short_control": Kind(3, SHORT),
        "contact": Kind(4, systems=TOUCHING, variants=("positions_only", "varying_psi"), named=True),
        "contact_control": Kind(
            5, MappingProxyType({"control": True}), systems=TOUCHING, variants=("positions_only", "varying_psi")
        ),
        "unlisted": Kind(6, MappingProxyType({"effect": UNLISTED})),
        "triple": Kind(7, MappingProxyType({"count": 3})),
    }
)
MIXTURE = MappingProxyType(  # of 60
    {"effect": 25, "pair": 6, "contact": 8, "unlisted": 6, "control": 12, "contact_control": 3}
)


@dataclass(frozen=True)
class Choice:
    """From which systems cases are drawn (none: the kind's own), whether without variants, what they conceal by name.

    Of the systems a kind with contact takes those that touch.
    """

    systems: tuple[str, ...] = ()
    plain: bool = False
    names: tuple[str, ...] = ()

    def systems_of(self, kind: Kind) -> tuple[str, ...]:
        """Those that a kind's cases are drawn from."""
        if kind.systems == TOUCHING:
            return tuple(name for name in self.systems if name in TOUCHING) or TOUCHING
        return self.systems or kind.systems


def draws(seed: str, kind: str, index: int, choice: Choice) -> Iterator[dict[str, Any]]:
    """Arguments of make_case for case `index` of a kind, one draw after the other; half have one or two variants.

    `seed` is hexadecimal.
    """
    of = KINDS[kind]
    rng, systems = np.random.default_rng([int(seed, 16), of.number, index]), choice.systems_of(of)
    effect = choice.names[index % len(choice.names)] if choice.names and of.named else None
    for _ in range(MOST_DRAWS):
        system = systems[rng.integers(len(systems))]
        options = [name for name in possible(SYSTEMS[system]) if name in of.variants]
        count = int(rng.integers(1, MOST_VARIANTS + 1)) if rng.uniform() < 0.5 and not choice.plain else 0
        variants = tuple(sorted(rng.choice(options, count, replace=False).tolist()))
        number = int(rng.integers(2**31))
        yield {"seed": number, "system": system, "effect": effect, "variants": variants, **of.options}


def draw_case(seed: str, kind: str, index: int, choice: Choice) -> ConcealedCase:
    """The first draw of a case that can be concealed. Raises ValueError where none can."""
    for drawn in draws(seed, kind, index, choice):
        with suppress(ValueError):
            return make_case(**drawn)
    wanted = choice.names[index % len(choice.names)] if choice.names and KINDS[kind].named else "an effect"
    raise ValueError(f"{wanted}: concealed in none of {MOST_DRAWS} drawn systems")


def mixture(studies: int) -> dict[str, int]:
    """So many studies by kind, in the shares of MIXTURE (largest remainders)."""
    shares = {kind: studies * part / sum(MIXTURE.values()) for kind, part in MIXTURE.items()}
    counts = {kind: math.floor(share) for kind, share in shares.items()}
    rest = sorted(shares, key=lambda kind: counts[kind] - shares[kind])
    return counts | {kind: counts[kind] + 1 for kind in rest[: studies - sum(counts.values())]}
