"""The commands `det2stoc import`, `fetch` and `export-recordings`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from det2stoc_bayes.cli import Debug, Json, Seed, StudyFolder, app
from det2stoc_bayes.cli_given import new_folder
from det2stoc_bayes.cli_help import EXAMPLES
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers import FORMATS
from det2stoc_bayes.importers.public import NAMES
from det2stoc_bayes.streams import reporting, show

FORMAT_NAMES = (*FORMATS, "urdf")


def _each(metavar: str, what: str) -> Any:
    return typer.Option(metavar=metavar, show_default=False, help=what + " Once for each.")


@app.command("import", epilog=EXAMPLES["import"])
def import_(
    form: Annotated[
        str, typer.Argument(metavar="FORMAT", help=f"One of: {listing(FORMAT_NAMES)}.", show_default=False)
    ],
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="A file or a folder.", show_default=False)],
    out: Annotated[Path, new_folder("The new study's folder.", "STUDY")],
    model: Annotated[Path | None, typer.Option(metavar="FILE", help="The MJCF or URDF that is believed.")] = None,
    map_file: Annotated[Path | None, typer.Option("--map", metavar="FILE", help="TOML with all of these.")] = None,
    column: Annotated[list[str] | None, _each("COLUMN=SIGNAL", "Which signal a column is.")] = None,
    unit: Annotated[list[str] | None, _each("COLUMN=UNIT", "A signal's unit: deg, mm, model; COLUMN may be *.")] = None,
    delay: Annotated[list[str] | None, _each("COLUMN=SECONDS", "How much older a value is than its stamp.")] = None,
    setting: Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", show_default=False,
                                                      help="What a format asks for alone.")] = None,
    clock: Annotated[str | None, typer.Option(metavar="UNIT", help="Of times: s, ms, us, ns; of a bag: header, "
                                              "received.")] = None,
    period: Annotated[float | None, typer.Option(min=1e-9, max=1e6, help="Seconds from row to row.")] = None,
    phase: Annotated[str | None, typer.Option(metavar="WHEN", help="When a row's control acts: after, before, "
                                              "centred.")] = None,
    only: Annotated[str | None, typer.Option(metavar="PATTERN", help="Read the recordings of these names.")] = None,
    holdout: Annotated[str | None, typer.Option(metavar="PATTERN", help="Hold these recordings out.")] = None,
    psi: Annotated[Path | None, typer.Option(metavar="FILE", help="TOML with psi, noise, known.")] = None,
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:  # fmt: skip
    """Write a study of recordings in another format; what the files do not say is asked for."""
    with reporting(debug):
        from det2stoc_bayes.importers.importing import import_study

        given = {"clock": clock, "period": period, "phase": phase, "only": only, "holdout": holdout}
        lists = {"columns": column or (), "units": unit or (), "delays": delay or (), "settings": setting or ()}
        done = import_study(form, source, out, model=model, psi=psi, map_file=map_file, **given, **lists)
    if as_json:
        told = {"study": str(out), "recordings": done.recordings, "holdout": done.holdout, "columns": done.columns}
        show(told | {"left_out": done.left_out, "psi": done.has_psi}, as_json)
        return
    count = f"{len(done.recordings)} recordings" + (f", {len(done.holdout)} held out" if done.holdout else "")
    lines = [f"{out}: {count} with {listing(done.columns, 20)}; SOURCE.md says what was done."]
    lines += [f"Not taken: {listing(done.left_out, 20)} (--column takes one)."] if done.left_out else []
    lines += (
        [] if done.recordings else [f"Put recordings into {out / 'recordings'}, or import some with its model.xml."]
    )
    lines += [] if done.has_psi else [f"Now say in {out / 'study.toml'} which parameters are uncertain, then: det2stoc "
                                      f"check {out}"]  # fmt: skip
    show("\n".join(lines), as_json)


@app.command(epilog=EXAMPLES["fetch"])
def fetch(
    name: Annotated[str, typer.Argument(metavar="NAME", help=f"One of: {listing(NAMES)}.", show_default=False)],
    out: Annotated[Path, new_folder("The new study's folder.", "STUDY")],
    mirror: Annotated[str | None, typer.Option(metavar="DIR|URL", help="Holds OWNER/REPO/COMMIT/PATH; by default "
                                               "raw.githubusercontent.com.", show_default=False)] = None,
    unverified: Annotated[bool, typer.Option("--unverified", help="Take files that are not those expected.")] = False,
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:  # fmt: skip
    """Download public recordings of a real system, and write them as a study."""
    with reporting(debug) as stages:
        from det2stoc_bayes.importers.public.fetch import fetch_study

        done = fetch_study(name, out, mirror=mirror, unverified=unverified, progress=stages)
    if as_json:
        show({"study": str(out), "files": done.files, "checked": done.checked, "recordings": done.recordings}, as_json)
        return
    show(f"{out}: {len(done.recordings)} recordings from {len(done.files)} files, {done.checked}; now: det2stoc check "
         f"{out}", as_json)  # fmt: skip


@app.command("export-recordings", epilog=EXAMPLES["export-recordings"])
def export_recordings(
    study: StudyFolder,
    out: Annotated[Path, new_folder("Where the files go.")],
    to: Annotated[Literal["sysid"], typer.Option(help="The format: mujoco.sysid's .npz.")] = "sysid",
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Write a study's recordings for another tool."""
    with reporting(debug):
        from det2stoc_bayes.importers.sysid_export import export_sysid
        from det2stoc_bayes.study import load_study

        written = export_sysid(load_study(study), out)
    shown = f"{len(written)} recordings for mujoco.{to} in {out}"
    show({"files": [str(path) for path in written]} if as_json else shown, as_json)
