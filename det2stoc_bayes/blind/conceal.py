"""Make a study in which reality has physics that the believed model lacks, and keep the answer apart."""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from det2stoc_bayes.blind.equivalents import accepted
from det2stoc_bayes.blind.laws import LAWS
from det2stoc_bayes.blind.sizing import (
    LARGEST,
    SMALLEST,
    UNABSORBED,
    Found,
    Probe,
    draw_probe,
    experiment,
    find,
)
from det2stoc_bayes.blind.systems import SYSTEMS, System
from det2stoc_bayes.blind.text import csv_text, study_text

HOLDOUTS = 3


@dataclass(frozen=True)
class ConcealedCase:
    """A study's files and, apart from them, the answer."""

    seed: int
    study_files: dict[str, str]
    answer: dict[str, Any]

    def write(self, folder: Path) -> Path:
        """Write the study's files, and nothing of the answer."""
        for name, text in self.study_files.items():
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        return Path(folder)


def combinations(system: System, effect: str | None = None) -> list[tuple[str, str]]:
    """(effect, element) pairs that this system may conceal: those that psi does not absorb."""
    elements = {
        "joint": system.joints,
        "body": system.bodies,
        "actuator": system.actuators,
        "sensor": tuple(system.columns()),
        "simulator": ("option",),
    }
    names = LAWS if effect is None else (effect,)
    pairs = [(name, element) for name in names for element in elements[LAWS[name].kind]]
    return [pair for pair in pairs if pair not in system.absorbed]


def make_case(
    seed: int,
    *,
    system: str | None = None,
    effect: str | None = None,
    size: float | None = None,
    control: bool = False,
    num_recordings: int = 8,
    num_samples: int = 300,
) -> ConcealedCase:
    """A case drawn from the seed; what is given is kept. `size` is in noise sds; a control conceals nothing.

    Raises ValueError for a system or effect that is not known, or that no draw makes visible beside psi.
    """
    rng = np.random.default_rng([seed, 20261])
    chosen, name = _choose(rng, system, effect)
    for _ in range(12):
        psi = chosen.draw_psi(rng)
        times = float(rng.choice(chosen.sampling)) * np.arange(num_samples)
        probe = draw_probe(rng, chosen, psi, times)
        if control:
            return _record(seed, rng, probe, None, num_recordings)
        pairs = combinations(chosen, name)
        pair = pairs[rng.integers(len(pairs))]
        wanted = size or float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
        found = find(rng, probe, pair, wanted, fixed=size is not None)
        if found is not None:
            return _record(seed, rng, probe, found, num_recordings)
    raise ValueError(f"{name} on {chosen.name}: no draw leaves {UNABSORBED} noise sds that psi cannot absorb")


def _choose(rng: np.random.Generator, system: str | None, effect: str | None) -> tuple[System, str]:
    for given, known in ((system, SYSTEMS), (effect, LAWS)):
        if given is not None and given not in known:
            raise ValueError(f"{given!r} is not known; there are {', '.join(known)}")
    options = [
        (one, name)
        for one in ([SYSTEMS[system]] if system else SYSTEMS.values())
        for name in ([effect] if effect else LAWS)
        if combinations(one, name)
    ]
    if not options:
        raise ValueError(f"on {system} psi absorbs {effect}")
    return options[rng.integers(len(options))]


def _record(
    seed: int, rng: np.random.Generator, probe: Probe, found: Found | None, num_recordings: int
) -> ConcealedCase:
    """Record fresh experiments with the effect on, add noise, and write everything as text."""
    system, psi, noise = probe.system, probe.psi, probe.system.noise()
    effect = found.effect if found else None
    step, integrator = (found and found.believed) or (None, None)
    files = {"model.xml": system.xml(step, integrator), "study.toml": study_text(system)}
    for folder, prefix, count in (("recordings", "rec", num_recordings), ("holdout", "hold", HOLDOUTS)):
        for index in range(1, count + 1):
            _, inputs, columns = experiment(rng, system, psi, effect, probe.times)
            columns = columns + noise * rng.standard_normal(columns.shape)
            text = csv_text(system, probe.times, columns, inputs)
            files[f"{folder}/{prefix}_{index:02d}.csv"] = text
    answer: dict[str, Any] = {
        "verdict": "no_mismatch" if effect is None else "mismatch",
        "system": system.name,
        "effects": [],
        "psi": psi,
        "size_in_noise_sds": found.size if found else 0.0,
        "unabsorbed_in_noise_sds": found.left if found else 0.0,
    }
    if effect is not None:
        entry = {"name": effect.name, "element": {"kind": effect.kind, "name": effect.element}}
        answer["effects"] = [{**entry, "parameters": effect.parameters, "accepted": accepted(system, psi, effect)}]
    return ConcealedCase(seed, files, answer)


def main(arguments: list[str] | None = None) -> None:
    """Write one concealed study; the answer is printed on request only."""
    parser = argparse.ArgumentParser(prog="det2stoc_bayes.blind.conceal", description=main.__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--system", choices=list(SYSTEMS))
    parser.add_argument("--effect", choices=list(LAWS))
    parser.add_argument("--size", type=float, help="in noise sds")
    parser.add_argument("--control", action="store_true", help="conceal nothing")
    parser.add_argument("--recordings", type=int, default=8)
    parser.add_argument("--samples", type=int, default=300)
    parser.add_argument("--reveal", action="store_true", help="print the answer")
    a = parser.parse_args(arguments)
    case = make_case(
        a.seed,
        system=a.system,
        effect=a.effect,
        size=a.size,
        control=a.control,
        num_recordings=a.recordings,
        num_samples=a.samples,
    )
    case.write(a.out)
    if a.reveal:
        print(json.dumps(case.answer, indent=1))


if __name__ == "__main__":
    main()
