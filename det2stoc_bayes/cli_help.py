"""Examples that `--help` ends with, and names that the shell completes; importing this costs nothing."""

from collections.abc import Callable, Iterable
from pathlib import Path
from pkgutil import iter_modules

SHELL = "\b\nCompletion of commands, options and names: det2stoc --install-completion"


def _examples(*lines: str) -> str:
    return "\n".join(("\b", "Examples:" if len(lines) > 1 else "Example:", *(f"  {line}" for line in lines)))


EXAMPLES = {
    "check": _examples("det2stoc check studies/arm", "det2stoc check studies/arm --json"),
    "fit": _examples(
        "det2stoc fit studies/arm --method laplace --out fits/arm",
        "det2stoc fit studies/arm --method svi --refine psis --out fits/svi",
        "det2stoc fit studies/arm --method npe --num-samples 4000 --seed 3 --out fits/npe",
    ),
    "compare": _examples(
        "det2stoc compare studies/arm --methods laplace,svi+psis,emcee --out compared",
        "det2stoc compare pendulum --methods npe,nuts --num-seeds 5 --jobs 2 --out compared",
    ),
    "calibrate": _examples("det2stoc calibrate linear_gaussian --method laplace --out calibrated"),
    "diagnose": _examples(
        "det2stoc diagnose studies/arm --out diagnosis", "det2stoc diagnose studies/arm --exact --json --out diagnosis"
    ),
    "reproduce": _examples(
        "det2stoc reproduce trivariate --quick --out trivariate", "det2stoc reproduce yumi-pusher --quick --out pusher"
    ),
    "export": _examples("det2stoc export studies/arm fits/arm --draws 200 --out randomized"),
    "effects": _examples("det2stoc effects", "det2stoc effects --json"),
    "import": _examples(
        "det2stoc import csv log.csv --model arm.xml --column qpos/wrist=angle --unit 'qpos/*=deg' --clock ms "
        "--out studies/arm",
    ),
    "fetch": _examples("det2stoc fetch pendulum_multiarm --out pendulum"),
    "export-recordings": _examples("det2stoc export-recordings studies/arm --to sysid --out sysid"),
    "blind": _examples("det2stoc blind --studies 60 --jobs 2 --out blind"),
    "serve": _examples("det2stoc serve results", "det2stoc serve . --port 0 --open"),
}


def starting(names: Callable[[], Iterable[str]], *, listed: bool = False) -> Callable[[str], list[str]]:
    """What completes a name, or, `listed`, the last one of a list with commas."""

    def completed(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",") if listed else ("", "", incomplete)
        return [f"{before}{comma}{name}" for name in names() if name.startswith(last)]

    return completed


def methods() -> Iterable[str]:
    """Inference methods, without what importing one brings."""
    folder = str(Path(__file__).with_name("inference"))
    return sorted(module.name for module in iter_modules([folder]) if not module.name.startswith("_"))


def experiments() -> Iterable[str]:
    """What `reproduce` knows."""
    from det2stoc_bayes.reproduce import EXPERIMENTS

    return EXPERIMENTS
