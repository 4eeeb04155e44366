"""A demonstration: conceal an effect, have the study diagnosed by another process, reveal the answer."""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from det2stoc_bayes.blind.conceal import ConcealedCase, make_case
from det2stoc_bayes.blind.laws import LAWS
from det2stoc_bayes.blind.score import score
from det2stoc_bayes.blind.systems import SYSTEMS
from det2stoc_bayes.blind.variants import VARIANTS

QUICK = ("pendulum", "cart_pole", "slider")  # whose diagnosis takes half a minute


def main(arguments: list[str] | None = None) -> int:
    """Make a concealed study, diagnose it, and show the diagnosis beside the answer."""
    parser = argparse.ArgumentParser(prog="make demo", description=main.__doc__)
    parser.add_argument("--seed", type=int, help="default: from the operating system's entropy")
    parser.add_argument("--out", type=Path, default=Path("out"), help="parent of the demo's folder")
    parser.add_argument("--system", choices=list(SYSTEMS), help=f"default: one of {', '.join(QUICK)}")
    parser.add_argument("--effect", choices=list(LAWS))
    parser.add_argument("--control", action="store_true", help="conceal nothing")
    parser.add_argument("--count", type=int, choices=(1, 2, 3), default=1, help="effects that are concealed at once")
    parser.add_argument("--variant", action="append", choices=list(VARIANTS), default=[], help="may be repeated")
    a = parser.parse_args(arguments)
    console = Console()
    seed = int.from_bytes(os.urandom(4), "big") if a.seed is None else a.seed
    folder = a.out / f"demo-{seed}"
    study, diagnosis_folder = folder / "study", folder / "diagnosis"
    system = a.system or (None if a.effect or a.variant else QUICK[seed % len(QUICK)])
    what = "nothing" if a.control else "an effect" if a.count == 1 else f"{a.count} effects"
    console.print(f"[bold]Seed {seed}, {system or 'any system'}[/bold]: concealing {what} in a study under {study} ...")
    options = {"effect": a.effect, "count": a.count, "control": a.control, "variants": tuple(a.variant)}
    try:
        case = make_case(seed, system=system, **options)
    except ValueError as error:  # there is no such study
        console.print(f"error: {error}", soft_wrap=True)
        return 2
    case.write(study)
    console.print(f"The study has {len(case.study_files)} files; the answer is in this process's memory only.")
    time = "ten minutes or more" if SYSTEMS[case.answer["system"]].touching else "a minute or two"
    console.print(f"Now another process diagnoses it; this takes {time}.\n")
    command = [sys.executable, "-m", "det2stoc_bayes", "diagnose", str(study), "--out", str(diagnosis_folder)]
    try:
        code = subprocess.run(command, check=False).returncode
    except KeyboardInterrupt:
        console.print("\nInterrupted; the study and what is finished are kept.")
        return 130
    result = diagnosis_folder / "diagnosis.json"
    if code != 0 or not result.is_file():
        how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
        console.print(f"[red]The diagnosis {how}[/red] and left no result to compare. Run again:")
        console.print("  " + " ".join(command), soft_wrap=True)
        return 128 - code if code < 0 else code or 1
    reveal(case, json.loads(result.read_text(encoding="utf-8")), console)
    return 0


def reveal(case: ConcealedCase, diagnosis: Mapping[str, Any], console: Console) -> None:
    """Print the answer and the diagnosis side by side."""
    answer = case.answer
    table = Table(title=f"Seed {case.seed}, {answer['system']}")
    for heading in ("", "concealed", "diagnosed"):
        table.add_column(heading)
    table.add_row("verdict", answer["verdict"], diagnosis["verdict"])
    truths, found = answer["effects"], diagnosis.get("effects") or []
    for index in range(max(len(truths), len(found), 1)):
        truth = truths[index] if index < len(truths) else None
        given = found[index] if index < len(found) else None
        table.add_row("effect", truth["name"] if truth else "none", given["name"] if given else "none")
        table.add_row("on", _element(truth), _element(given))
        for key in {**(truth or {}).get("parameters", {}), **(given or {}).get("parameters", {})}:
            value = truth["parameters"].get(key, "") if truth else ""
            estimate = given["parameters"].get(key) if given else None
            table.add_row(f"  {key}", escape(_short(value)), escape(_estimate(estimate)))
        alike = (truth["accepted"] if truth else (), (given or {}).get("equivalent") or ())
        texts = [", ".join(f"{other['name']} {_element(other)}".strip() for other in others) for others in alike]
        if any(texts):
            table.add_row("  or equally", *texts)
    for name, value in answer["psi"].items():
        after = (diagnosis.get("psi") or {}).get(name, {}).get("after")
        table.add_row(f"psi {name}", f"{value:.4g}", _mean_sd(after))
    console.print(table)
    for effect in truths:
        console.print(
            f"{effect['name']} changes the recordings by {effect['change_in_noise_sds']:.1f} noise sds; refitting "
            f"psi and the initial states can hide part of that, {effect['size_in_noise_sds']:.1f} remain."
        )
    if truths and found and {e["name"] for e in truths} != {e["name"] for e in found}:
        console.print("psi are those beside the effect that was diagnosed; beside the concealed one they are others.")
    outcome = score(answer, diagnosis)
    right = outcome.verdict and outcome.named
    console.print("[bold green]Right.[/bold green]" if right else "[bold red]Not right.[/bold red]")


def _element(entry: Mapping[str, Any] | None) -> str:
    if not entry or "element" not in entry:
        return ""
    return f"{entry['element']['kind']} {entry['element']['name']}"


def _estimate(entry: Mapping[str, Any] | str | None) -> str:
    if entry is None:
        return ""
    if isinstance(entry, str):  # an integrator's name
        return entry
    interval, mean = entry.get("interval"), entry.get("mean")
    if isinstance(mean, int | float) and interval:
        return f"{mean:.4g} [{interval[0]:.4g}, {interval[1]:.4g}] {entry.get('unit', '')}"
    return _short(mean if mean is not None else entry)


def _short(value: Any) -> str:
    """Numbers, or lists of them, to four digits; anything else as it is."""
    if isinstance(value, list):
        return f"[{', '.join(map(_short, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _mean_sd(after: Mapping[str, Any] | None) -> str:
    if not after:
        return ""
    return (
        f"{after['mean']} +- {after['sd']}"
        if isinstance(after["mean"], list)
        else (f"{after['mean']:.4g} +- {after['sd']:.2g}")
    )


if __name__ == "__main__":
    raise SystemExit(main())
