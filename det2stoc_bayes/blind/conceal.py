"""Make a study in which reality has physics that the believed model lacks, and keep the answer apart."""

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from det2stoc_bayes.blind.equivalents import accepted, entry, on_a_list
from det2stoc_bayes.blind.laws import INTEGRATION, LAWS, NAMES
from det2stoc_bayes.blind.probe import Probe, draw_probe
from det2stoc_bayes.blind.recordings import record
from det2stoc_bayes.blind.short_sizing import find_short
from det2stoc_bayes.blind.sizing import (
    LARGEST,
    SMALLEST,
    Found,
    all_kept,
    clash,
    combinations,
    draw_size,
    find,
    judged_components,
)
from det2stoc_bayes.blind.systems import SYSTEMS
from det2stoc_bayes.blind.variants import VARIANTS, Setting, choose, possible
from det2stoc_bayes.engines.quiet import QUIET, UNTIMED
from det2stoc_bayes.files import write_all

ATTEMPTS = 6  # draws of a system, psi and experiments
FEWEST_SAMPLES = 20
DRAWS = 4  # of effects for each of them


@dataclass(frozen=True)
class ConcealedCase:
    """A study's files and, apart from them, the answer."""

    seed: int
    study_files: dict[str, str]
    answer: dict[str, Any]

    def encoded(self) -> dict[str, bytes]:
        """The study's files, and nothing of the answer."""
        return {name: text.encode("utf-8") for name, text in self.study_files.items()}

    def write(self, folder: Path) -> Path:
        """Write the study's files."""
        return write_all(folder, self.encoded())


@UNTIMED
@QUIET  # sizes are tried that a simulation does not survive
def make_case(
    seed: int,
    *,
    system: str | None = None,
    effect: str | None = None,
    others: tuple[str, ...] = (),
    count: int = 1,
    size: float | None = None,
    control: bool = False,
    variants: tuple[str, ...] = (),
    num_recordings: int = 8,
    num_samples: int | None = None,
) -> ConcealedCase:
    """A case drawn from the seed; what is given is kept. `size` is in noise sds; a control conceals nothing.

    `count` effects are concealed at once, `others` names those beside `effect`. Raises ValueError for a name that is
    not known, and where no draw gives effects of 3 to 30 noise sds that psi, and the other ones, cannot absorb.
    """
    for given, known in ((system, SYSTEMS), *((name, NAMES) for name in (effect, *others))):
        if given is not None and given not in known:
            raise ValueError(f"{given!r} is not known; there are {', '.join(known)}")
    if control and (effect or others or count > 1):
        raise ValueError("a control conceals nothing; allowed: no effects beside it")
    count = 0 if control else max(count, 1 + len(others))
    if INTEGRATION in (effect, *others) and count > 1:
        raise ValueError(f"{INTEGRATION} is concealed alone")
    if num_recordings < 1 or (num_samples is not None and num_samples < FEWEST_SAMPLES):
        found = f"{num_recordings} recordings of {num_samples or 'the usual number of'} samples"
        raise ValueError(f"{found}; allowed: 1 or more, of {FEWEST_SAMPLES} or more")
    if size is not None and not SMALLEST <= size <= LARGEST:
        raise ValueError(f"size {size:g}; allowed: {SMALLEST:g} to {LARGEST:g} noise sds")
    rng = np.random.default_rng([seed, 20261])
    wanted = [effect, *others, *[None] * count][:count]
    options = [SYSTEMS[system]] if system else [s for s in SYSTEMS.values() if set(variants) <= set(possible(s))]
    for _ in range(ATTEMPTS):
        setting = choose(rng, options[rng.integers(len(options))], variants)
        psi = setting.system.draw_psi(rng)
        times = float(rng.choice(setting.system.sampling)) * np.arange(num_samples or setting.system.samples)
        probe = draw_probe(rng, setting.system, psi, times, tuple(setting.varying))
        found = _draw(rng, probe, wanted, size)
        made = None if found is None else record(rng, setting, probe, found, num_recordings)
        if found is not None and made is not None:
            files, more = made
            samples = num_recordings * probe.plain[0].size
            return ConcealedCase(seed, files, _answer(rng, setting, probe, found, samples) | more)
    names = " and ".join(name or "an effect" for name in wanted)
    raise ValueError(
        f"{names} on {system or 'any system'}: no draw within its physical range leaves {SMALLEST:g} noise sds that "
        "psi cannot absorb"
    )


def _draw(rng: np.random.Generator, probe: Probe, wanted: list[str | None], size: float | None) -> list[Found] | None:
    """One effect for each wanted name (None: any), such that none can be absorbed; None where no draw gives that."""
    for _ in range(DRAWS):
        found: list[Found] = []
        for name in wanted:
            pairs = [p for p in combinations(probe, name) if not any(clash(p, _place(f)) for f in found)]
            if len(wanted) > 1:
                pairs = [p for p in pairs if p[0] != INTEGRATION]
            if not pairs:
                return None
            pick = _pick(rng, pairs)
            if probe.system.touching:
                one = find_short(rng, probe, pick)
            else:
                one = find(rng, probe, pick, size or draw_size(rng), fixed=size is not None)
            if one is None or (LAWS[pick[0]].variables and on_a_list(rng, probe, one.effect, one.size)):
                break
            found.append(one)
        if len(found) == len(wanted) and (len(found) < 2 or all_kept(probe, found)):
            return found
    return None


def _pick(rng: np.random.Generator, pairs: list[tuple[str, str]]) -> tuple[str, str]:
    """A law first, then its element, so that laws with many elements are not drawn more often."""
    names = list(dict.fromkeys(name for name, _ in pairs))
    name = names[rng.integers(len(names))]
    mine = [p for p in pairs if p[0] == name]
    return mine[rng.integers(len(mine))]


def _place(found: Found) -> tuple[str, str]:
    return found.effect.name, found.effect.element


def _answer(
    rng: np.random.Generator, setting: Setting, probe: Probe, found: list[Found], samples: int
) -> dict[str, Any]:
    """What is concealed, what else counts as right, and how large it is."""
    effects = [
        entry(f.effect)
        | {
            "accepted": [] if f.believed or probe.system.touching else accepted(rng, probe, f.effect, samples),
            "judged": {} if probe.system.touching else judged_components(probe, f.effect),
            "size_in_noise_sds": f.size,
            "change_in_noise_sds": f.change,
        }
        for f in found
    ]
    return {
        "verdict": "mismatch" if found else "no_mismatch",
        "system": setting.system.name,
        "variants": list(setting.variants),
        "effects": effects,
        "psi": probe.psi,
    }


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"found '{text}'; allowed: a whole number from 0 on")
    return int(text)


def main(arguments: list[str] | None = None) -> int:
    """Write one concealed study; the answer is printed on request only."""
    parser = argparse.ArgumentParser(prog="det2stoc_bayes.blind.conceal", description=main.__doc__)
    parser.add_argument("--seed", type=_seed, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--system", choices=list(SYSTEMS))
    parser.add_argument("--effect", choices=NAMES, action="append", default=[], help="may be repeated")
    parser.add_argument("--count", type=int, choices=(1, 2, 3), default=1, help="effects at once")
    parser.add_argument("--size", type=float, help="in noise sds that psi cannot absorb")
    parser.add_argument("--control", action="store_true", help="conceal nothing")
    parser.add_argument("--variant", action="append", choices=list(VARIANTS), default=[], help="may be repeated")
    parser.add_argument("--recordings", type=int, default=8)
    parser.add_argument("--samples", type=int, help="of a recording; default: the system's own")
    parser.add_argument("--reveal", action="store_true", help="print the answer")
    a = parser.parse_args(arguments)
    if a.out.exists() and (not a.out.is_dir() or any(a.out.iterdir())):
        print(f"error: --out {a.out}: is there already; allowed: a new name, or an empty folder", file=sys.stderr)
        return 2
    what = "nothing" if a.control else "one effect" if max(a.count, len(a.effect)) == 1 else "effects"
    print(f"drawing a study with {what} concealed: up to a minute, longer with contact", file=sys.stderr)
    try:
        case = make_case(
            a.seed,
            system=a.system,
            effect=next(iter(a.effect), None),
            others=tuple(a.effect[1:]),
            count=a.count,
            size=a.size,
            control=a.control,
            variants=tuple(a.variant),
            num_recordings=a.recordings,
            num_samples=a.samples,
        )
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    case.write(a.out)
    hint = "" if a.reveal else "; --reveal and another --out print what is concealed"
    print(f"a study in {a.out}{hint}", file=sys.stderr)
    if a.reveal:
        print(json.dumps(case.answer, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
