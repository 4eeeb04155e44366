"""The command `det2stoc blind`."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from det2stoc_bayes.cli import Cluster, Debug, Json, app
from det2stoc_bayes.cli_given import new_folder
from det2stoc_bayes.cli_help import EXAMPLES
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.files import atomic_write, check_folder
from det2stoc_bayes.streams import reporting, show_report

if TYPE_CHECKING:
    # Dotted names, so that the checker of the tests can look them up.
    import rich.console

    import det2stoc_bayes.blind.summary

DEFAULT = 20  # studies
LOG = "concealed.jsonl"


def _count(what: str) -> Any:
    return typer.Option(min=0, metavar="N", show_default=False, help=what)


@app.command(epilog=EXAMPLES["blind"])
def blind(
    out: Annotated[Path, new_folder("Where log and report go.")],
    studies: Annotated[int | None, _count("Of all kinds, for those without a number; 20 if none has one.")] = None,
    effects: Annotated[int | None, _count("Studies that conceal one effect.")] = None,
    pairs: Annotated[int | None, _count("Studies that conceal two.")] = None,
    triples: Annotated[int | None, _count("Studies that conceal three.")] = None,
    controls: Annotated[int | None, _count("Studies that conceal nothing.")] = None,
    short_controls: Annotated[int | None, _count("The same with three short recordings.")] = None,
    contact: Annotated[int | None, _count("Studies that conceal an effect where bodies touch.")] = None,
    contact_controls: Annotated[int | None, _count("The same that conceal nothing.")] = None,
    unlisted: Annotated[int | None, _count("Studies that conceal an effect on no list.")] = None,
    seed: Annotated[
        str | None, typer.Option(metavar="HEX", help="By default the first 8 digits of git's HEAD, or 0.")
    ] = None,
    systems: Annotated[str, typer.Option(metavar="A,B,...", help="Draw from these systems alone.")] = "",
    names: Annotated[
        str, typer.Option(metavar="A,B,...", help="What single effects are, in turn, with and without contact.")
    ] = "",
    plain: Annotated[bool, typer.Option("--plain", help="States recorded evenly, noise told.")] = False,
    log: Annotated[Path | None, typer.Option(metavar="FILE", help="By default DIR/concealed.jsonl.")] = None,
    rescore: Annotated[
        Path | None, typer.Option(metavar="LOG", help="Score a log's cases anew; of --seed alone if given.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Studies at a time; 0: one a core.")] = 1,
    cluster: Cluster = None,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Conceal physics in studies, have others diagnose them, and score; goes on where it was interrupted."""
    with reporting(debug) as stages:
        check_folder(out)
        from det2stoc_bayes.blind import proof
        from det2stoc_bayes.blind.draw import Choice, mixture
        from det2stoc_bayes.blind.laws import LAWS
        from det2stoc_bayes.blind.page import proof_page
        from det2stoc_bayes.blind.summary import row, summarize
        from det2stoc_bayes.blind.systems import SYSTEMS
        from det2stoc_bayes.mismatch.finding import plain as finite

        if seed is not None and not re.fullmatch("[0-9a-fA-F]{1,40}", seed):
            raise Det2StocError(f"--seed: found '{seed}'; allowed: 1 to 40 hexadecimal digits")
        given = {"effect": effects, "pair": pairs, "control": controls, "short_control": short_controls}
        given |= {"triple": triples, "contact": contact, "contact_control": contact_controls, "unlisted": unlisted}
        counts = {kind: number for kind, number in given.items() if number is not None}
        if rescore is not None:
            lines, told = _logged(rescore, seed), {"log": str(rescore)}
        else:
            if studies is not None or not counts:
                counts = mixture(DEFAULT if studies is None else studies) | counts
            if not sum(counts.values()):
                raise Det2StocError("--studies, --effects and the like: found 0 in all; allowed: at least one study")
            choice = Choice(_listed("--systems", systems, SYSTEMS), plain, _listed("--names", names, LAWS))
            commit, path = proof.revision(), log or out / LOG
            seed = seed or commit[:8] or "0"
            options = {"seed": seed, "commit": commit, "jobs": jobs, "cluster": cluster, "progress": stages}
            lines = proof.run(counts, choice, path, **options)
            told = {"log": str(path), "seed": seed, "commit": commit}
        rows = [row(line) for line in lines]
        summary = summarize(rows)
        told |= summary.to_json() | {"cases": [_case(line, r) for line, r in zip(lines, rows, strict=True)]}
        atomic_write(out / "report.html", proof_page(lines, rows, summary))
        atomic_write(out / "blind.json", json.dumps(finite(told), indent=2))
    show_report(told if as_json else _tables(rows, summary), out, as_json)


def _logged(path: Path, seed: str | None) -> list[dict[str, Any]]:
    """A log's cases, of one seed if that is given."""
    from det2stoc_bayes.blind.proof import read

    lines, other = read(path)
    mine = [line for line in lines if seed in (None, line.get("seed"))]
    if not mine:
        found = f"{len(lines)} cases, none of seed {seed}" if lines else f"{other} lines, none of which is a case"
        raise Det2StocError(f"--rescore {path}: found {found}; allowed: a log of `det2stoc blind`")
    return mine


def _listed(option: str, given: str, known: Any) -> tuple[str, ...]:
    """Names that are separated by commas."""
    from det2stoc_bayes.suggestions import choices

    names = tuple(name.strip() for name in given.split(",") if name.strip())
    for name in names:
        if name not in known:
            raise Det2StocError(f"{option}: found '{name}'; {choices(name, known, 60)}")
    return names


def _case(line: dict[str, Any], r: "det2stoc_bayes.blind.summary.Row") -> dict[str, Any]:
    """A case for --json."""
    told = {"kind": r.kind, "index": line["index"], "system": r.system, "concealed": r.score.truth}
    told |= {"said": r.score.diagnosed, "right": r.score.named, "verdict": r.score.verdict}
    return told | {"improvement": r.score.improvement, "seconds": r.seconds, "peak_mb": r.megabytes}


def _tables(
    rows: "Sequence[det2stoc_bayes.blind.summary.Row]", summary: "det2stoc_bayes.blind.summary.Summary"
) -> "rich.console.RenderableType":
    """By kind, what is pooled, and what was not right."""
    from rich.console import Group
    from rich.text import Text

    from det2stoc_bayes.blind.summary import HEADINGS, cells, missed, sentences
    from det2stoc_bayes.tables import table

    made = table("concealed studies", "kind", *(f"{heading}>" for heading in HEADINGS))
    for tally in summary.kinds:
        made.add_row(tally.name, *cells(tally))
    return Group(made, "", *(Text(text) for text in sentences(summary)), *(Text(text) for text in missed(rows)))
