"""The command `det2stoc`: results to stdout, progress, warnings and errors to stderr.

Exit codes: 0 done; 1 something unforeseen; 2 an error that the user can act on; 130 interrupted.
"""

import io
import json
import sys
import warnings
from pathlib import Path
from typing import Annotated, Literal

import typer

from det2stoc_bayes.cli_given import KINDS, load, made_by, new_folder, study_or_problem
from det2stoc_bayes.cli_help import EXAMPLES, SHELL, experiments, methods, starting
from det2stoc_bayes.errors import Det2StocError, listing
from det2stoc_bayes.files import check_folder, check_kept
from det2stoc_bayes.models import POSED, VECTORS
from det2stoc_bayes.streams import reporting, show, show_report

LEAST_DRAWS, MOST_DRAWS, MOST_SEED = 4, 10_000_000, 2**63 - 1
REFINED = "svi+psis for a refined one"
METHODS = listing(methods(), 20)
DIAGNOSED = "patched.xml", "effects.py", "fit.nc", "report.html", "diagnosis.json"
EQUAL = "as many more as make chains equally long"

app = typer.Typer(
    name="det2stoc",
    help="Posteriors over simulator parameters, and the physics that a simulator leaves out.",
    no_args_is_help=True,
    epilog=SHELL,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)

StudyFolder = Annotated[Path, typer.Argument(metavar="STUDY", help="The study's folder.", show_default=False)]
StudyOrProblem = Annotated[
    str, typer.Argument(metavar="STUDY|PROBLEM", help=f"One of: {listing((*KINDS, *POSED), 9)}.", show_default=False)
]
AnyProblem = Annotated[
    str,
    typer.Argument(metavar="STUDY|PROBLEM", help=f"One of: {listing((*KINDS, *VECTORS), 9)}.", show_default=False),
]
Seed = Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Everything random follows from it.")]
Json = Annotated[bool, typer.Option("--json", help="The result as JSON on stdout.")]
Jobs = Annotated[int, typer.Option(min=0, help="Processes, of one simulation thread each; 0: one a core.")]
Cluster = Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, as tcp://HOST:8786.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an unforeseen error.")]


def main() -> None:
    """Run the command line."""
    sys.stdout = sys.stdout or io.StringIO()  # closed by the caller
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names that the terminal's encoding lacks
    app(prog_name="det2stoc")


@app.command(epilog=EXAMPLES["check"])
def check(study: StudyFolder, seed: Seed = 0, as_json: Json = False, debug: Debug = False) -> None:
    """Say what a study's recordings can identify."""
    with reporting(debug) as stages:
        from det2stoc_bayes import identifiability, tables

        checked = identifiability.check(load(study), progress=stages)
    show(tables.check_json(checked) if as_json else tables.check_tables(checked), as_json)


@app.command(epilog=EXAMPLES["fit"])
def fit(
    study: StudyFolder,
    out: Annotated[Path, new_folder("Where fit.nc goes.")],
    method: Annotated[
        str, typer.Option(metavar="NAME", help=f"One of: {METHODS}.", autocompletion=starting(methods))
    ] = "nuts",
    engine: Annotated[Literal["c", "mjx"], typer.Option(help="MuJoCo in C, or in JAX.")] = "c",
    num_samples: Annotated[int, typer.Option(min=LEAST_DRAWS, max=MOST_DRAWS, help=f"Draws in all; {EQUAL}.")] = 1000,
    refine: Annotated[Literal["none", "psis"], typer.Option(help="Resample by the exact likelihood.")] = "none",
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Draw from the posterior of a study's psi."""
    with reporting(debug) as stages:
        check_folder(out, "fit.nc")
        from det2stoc_bayes import posterior, tables, verbs
        from det2stoc_bayes.doubts import doubts
        from det2stoc_bayes.inference import get_method
        from det2stoc_bayes.recording import StudyWarning
        from det2stoc_bayes.report.summary import predicted, summarize

        get_method(method, "--method")  # a name that does not exist is not worth reading a study for
        believed = load(study)
        options = {"seed": seed, "engine": engine, "num_samples": num_samples, "progress": stages}
        options |= {"refine": refine} if refine != "none" else {}
        tree = verbs.fit(believed, method, **options)
        rows, told, path = summarize(tree), predicted(tree), out / "fit.nc"
        if path.is_file():
            warnings.warn(f"{path}{made_by(path)} is replaced", StudyWarning, stacklevel=1)
        posterior.save(tree, path)
        for doubt in doubts(tree):
            warnings.warn(doubt, StudyWarning, stacklevel=1)
    count = posterior.num_draws(tree)
    title = f"{believed.name}, {method}: {f'{count} draws' if count else 'predictions'} in {path}"
    shown = tables.fit_json(rows, told, tree.attrs, str(path)) if as_json else tables.fit_tables(rows, told, title)
    show(shown, as_json)


@app.command(epilog=EXAMPLES["compare"])
def compare(
    problem: StudyOrProblem,
    methods: Annotated[
        str,
        typer.Option(
            metavar="A,B,...", help=f"Of: {METHODS}; {REFINED}.", autocompletion=starting(methods, listed=True)
        ),
    ],
    out: Annotated[Path, new_folder("Where runs and report go.")],
    engine: Annotated[Literal["c", "mjx"], typer.Option(help="MuJoCo in C, or in JAX.")] = "c",
    num_samples: Annotated[
        int, typer.Option(min=LEAST_DRAWS, max=MOST_DRAWS, help=f"Draws in all, of each method; {EQUAL}.")
    ] = 1000,
    num_seeds: Annotated[int, typer.Option(min=1, max=1000, help="Runs of each method, from --seed on.")] = 1,
    jobs: Jobs = 0,
    cluster: Cluster = None,
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Hold methods beside each other; the same command goes on where it was interrupted."""
    with reporting(debug) as stages:
        check_folder(out, "report.html", "comparison.json")
        check_folder(out / "runs")
        from det2stoc_bayes import tables, verbs
        from det2stoc_bayes.files import atomic_write
        from det2stoc_bayes.mismatch.finding import plain
        from det2stoc_bayes.recording import StudyWarning
        from det2stoc_bayes.report.compare_page import compare_page, misfits

        if seed > MOST_SEED - num_seeds:
            raise Det2StocError(
                f"--seed: found {seed} with --num-seeds {num_seeds}; allowed: at most {MOST_SEED} together"
            )
        asked = [name.strip() for name in methods.split(",") if name.strip()]
        options = {"seed": seed, "num_seeds": num_seeds, "engine": engine, "num_samples": num_samples}
        options |= {"jobs": jobs, "cluster": cluster, "progress": stages}
        believed = study_or_problem(problem, POSED)
        name = believed if isinstance(believed, str) else believed.name
        found = verbs.compare(believed, asked, out, **options)
        told = plain(tables.compare_json(found) | {"doubts": misfits(found)})
        page = compare_page(found, name=name, doubts=told["doubts"])
        atomic_write(out / "report.html", page)
        atomic_write(out / "comparison.json", json.dumps(told, indent=2))
        for warning in (*found.replaced, *told["doubts"]):
            warnings.warn(warning, StudyWarning, stacklevel=1)
    show_report(told if as_json else tables.compare_table(found, name), out, as_json)


@app.command(epilog=EXAMPLES["calibrate"])
def calibrate(
    problem: AnyProblem,
    method: Annotated[
        str, typer.Option(metavar="NAME", help=f"One of: {METHODS}; {REFINED}.", autocompletion=starting(methods))
    ],
    out: Annotated[Path, new_folder("Where replications and report go.")],
    num_replications: Annotated[
        int, typer.Option(min=20, max=MOST_DRAWS, help="Simulated and fitted data sets.")
    ] = 500,
    num_samples: Annotated[
        int, typer.Option(min=LEAST_DRAWS, max=MOST_DRAWS, help=f"Draws of a fit, at first; {EQUAL}.")
    ] = 200,
    engine: Annotated[Literal["c", "mjx"], typer.Option(help="MuJoCo in C, or in JAX.")] = "c",
    jobs: Jobs = 0,
    cluster: Cluster = None,
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Test whether a method's posteriors hold the truth as often as they say; goes on where it was interrupted."""
    with reporting(debug) as stages:
        check_folder(out, "replications.jsonl", "report.html", "calibration.json")
        from det2stoc_bayes import calibration, tables, verbs_calibrate
        from det2stoc_bayes.files import atomic_write
        from det2stoc_bayes.mismatch.finding import plain
        from det2stoc_bayes.report.calibration_page import calibration_page

        options = {"seed": seed, "engine": engine, "num_samples": num_samples, "jobs": jobs, "cluster": cluster}
        options |= {"num_replications": num_replications, "progress": stages}
        found = verbs_calibrate.calibrate(study_or_problem(problem, VECTORS), method, out, **options)
        told = calibration.to_json(found)
        atomic_write(out / "report.html", calibration_page(found))
        atomic_write(out / "calibration.json", json.dumps(plain(told), indent=2))
    show_report(told if as_json else tables.calibration_tables(found), out, as_json)


@app.command(epilog=EXAMPLES["diagnose"])
def diagnose(
    study: StudyFolder,
    out: Annotated[Path, new_folder("Where the report goes.")],
    exact: Annotated[bool, typer.Option("--exact", help="Draw the final posteriors by NUTS, and compare.")] = False,
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Find and model what the simulator leaves out."""
    with reporting(debug) as stages:
        check_folder(out, *DIAGNOSED)
        from det2stoc_bayes import verbs
        from det2stoc_bayes.engines.model_names import model_files
        from det2stoc_bayes.finding_tables import finding_tables

        believed = load(study)
        check_kept((out / name for name in DIAGNOSED), model_files(believed.model_path))
        diagnosis = verbs.diagnose(believed, seed=seed, exact=exact, progress=stages)
        diagnosis.write(out)
    finding = diagnosis.finding
    show_report(finding.model_dump(mode="json") if as_json else finding_tables(finding), out, as_json)


@app.command(epilog=EXAMPLES["reproduce"])
def reproduce(
    experiment: Annotated[
        str, typer.Argument(metavar="NAME", help=", ".join(experiments()), autocompletion=starting(experiments))
    ],
    out: Annotated[Path, new_folder("Where the results go.")],
    quick: Annotated[bool, typer.Option("--quick", help="A look in minutes.")] = False,
    jobs: Annotated[int, typer.Option(min=0, help="Processes; 0: two, one on a lone core or a GPU.")] = 0,
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Run an experiment of the source work again; the same command goes on where it was interrupted."""
    with reporting(debug) as stages:
        from det2stoc_bayes import tables
        from det2stoc_bayes.files import atomic_write
        from det2stoc_bayes.reproduce import get_experiment

        module = get_experiment(experiment)
        check_folder(out, "results.json", "report.html")
        result = module.run(out, seed=seed, quick=quick, jobs=jobs, progress=stages)
        atomic_write(out / "results.json", json.dumps(result))
        atomic_write(out / "report.html", module.page(result))
    show_report(result if as_json else tables.experiment_table(result), out, as_json)


@app.command(epilog=EXAMPLES["export"])
def export(
    study: StudyFolder,
    posterior_file: Annotated[Path, typer.Argument(metavar="FIT", help="fit.nc or its folder.", show_default=False)],
    out: Annotated[Path, new_folder("Where the draws go.")],
    draws: Annotated[int, typer.Option(min=1, max=MOST_DRAWS, help="How many.")] = 100,
    models: Annotated[bool, typer.Option("--models/--no-models", help="An MJCF a draw, beside the table.")] = True,
    seed: Seed = 0,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Write a posterior as a domain-randomization set: psi.csv, and an MJCF a draw."""
    with reporting(debug) as stages:
        check_folder(out, "psi.csv")
        from det2stoc_bayes import posterior, randomization

        def told(done: int, total: int) -> None:
            stages("writing models", done, total)

        tree = posterior.load(posterior_file)
        options = {"num_draws": draws, "seed": seed, "models": models, "progress": told}
        written = randomization.export(load(study), tree, out, **options)
    shown = {"draws": draws, "files": [str(path) for path in written]} if as_json else f"{draws} draws in {written[-1]}"
    show(shown, as_json)


@app.command(epilog=EXAMPLES["effects"])
def effects(seed: Seed = 0, as_json: Json = False, debug: Debug = False) -> None:
    """List the effects that a diagnosis knows."""
    with reporting(debug):
        from det2stoc_bayes import tables
        from det2stoc_bayes.mismatch.effects import CATALOGUE
    show(tables.effects_json(CATALOGUE) if as_json else tables.effects_table(CATALOGUE), as_json)


from det2stoc_bayes import cli_blind as cli_blind  # noqa: E402  a command that takes its options from here
from det2stoc_bayes import cli_import as cli_import  # noqa: E402  and those that bring recordings in and out
from det2stoc_bayes import cli_serve as cli_serve  # noqa: E402
