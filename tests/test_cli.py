"""The command line: what goes to which stream, exit codes, and that nothing is written after an error."""

import gc
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from io import StringIO
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import sliding
import typer
from conftest import HINGE, make_study, model_xml
from rich.console import Console
from typer.testing import CliRunner

from det2stoc_bayes import cli, identifiability, progress, streams, verbs, verbs_calibrate
from det2stoc_bayes.cli_help import EXAMPLES
from det2stoc_bayes.errors import StudyError
from det2stoc_bayes.identifiability import check
from det2stoc_bayes.study import load_study
from det2stoc_bayes.tables import check_tables

TOML = """
[psi.damping]
target = "joint/hinge/damping"
prior = { LogNormal = { loc = -3.0, scale = 0.5 } }

[psi.armature]
target = "joint/hinge/armature"
prior = { TruncatedNormal = { loc = 0.0, scale = 1e-9, low = 0.0, high = 2e-9 } }

[noise]
"qpos/*" = 0.001
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    """A swinging arm: its damping shows, its minute armature cannot."""
    folder = tmp_path_factory.mktemp("studies") / "arm"
    return make_study(folder, model_xml(HINGE), TOML, {"swing": _swing()}).folder


def _swing():
    import mujoco

    model = mujoco.MjModel.from_xml_string(model_xml(HINGE))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[0] = 1.0
    values = []
    for _ in range(76):
        values.append(data.qpos[0] + 0.001 * random.standard_normal())
        mujoco.mj_step(model, data, 10)
    return np.arange(76) * 0.02, {"qpos/hinge": values}


def run(*arguments: object):
    """A command in this process."""
    return CliRunner().invoke(cli.app, [str(a) for a in arguments])


def command(*arguments: str | Path, **options) -> subprocess.CompletedProcess:
    """A command in a process of its own."""
    line = [sys.executable, "-m", "det2stoc_bayes", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=240, **options)


def test_help_lists_what_exists_and_imports_no_library():
    code = "import sys; sys.argv = ['det2stoc', '--help']\n"
    code += "from det2stoc_bayes.cli import main\n"
    code += "try: main()\n"
    code += "except SystemExit as end: assert not end.code\n"
    code += "heavy = {'numpy', 'jax', 'mujoco', 'pydantic', 'xarray', 'scipy'} & set(sys.modules)\n"
    code += "assert not heavy, heavy"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert shown.returncode == 0, shown.stderr
    commands = shown.stdout.split("Commands:\n")[1].split("\n\n")[0]
    listed = [line.split()[0] for line in commands.splitlines()]
    expected = ["check", "fit", "compare", "calibrate", "diagnose", "reproduce", "export", "effects", "blind"]
    assert listed == [*expected, "import", "fetch", "export-recordings", "serve"]


def test_check_says_what_can_be_identified(study):
    shown = command("check", study)
    assert shown.returncode == 0
    assert "not identifiable" in shown.stdout
    assert "given" in shown.stdout
    assert "\x1b" not in shown.stdout + shown.stderr
    assert shown.stderr.splitlines() == [
        "simulating each recording at the prior's median",
        "fitting psi quickly",
        "comparing effects",
    ]
    told = " ".join(shown.stdout.split())
    assert "Missing effects that a wrong psi would hide completely: viscous_damping on joint hinge" in told
    assert "No effect has been looked for yet. Were one of these" in told and "speaks against it" not in told


def test_check_says_where_the_model_speaks_against_its_widths(study):
    checked = check(load_study(study))
    far = replace(checked, noise_inflation=13.2)
    shown = Console(record=True, width=400, file=StringIO())
    shown.print(check_tables(far))
    assert "after a quick fit the squared misfit is 13.2 x the noise's" in shown.export_text()
    guessed = replace(far, columns=tuple(replace(c, given=False) for c in far.columns))
    shown.print(check_tables(guessed))
    assert "speaks against it" not in shown.export_text()


def test_check_as_json(study):
    shown = run("check", study, "--json")
    assert shown.exit_code == 0, shown.output
    answer = json.loads(shown.stdout)
    assert {p["name"]: p["verdict"] for p in answer["psi"]} == {
        "damping": "identifiable",
        "armature": "not identifiable",
    }
    damping = answer["psi"][0]
    assert abs(damping["mean"] - 0.05) < 5 * damping["sd"]
    assert answer["recordings"] == [
        {"name": "swing", "role": "recording", "samples": 76, "seconds": 1.5, "columns": ["qpos/hinge"],
         "misfit": answer["recordings"][0]["misfit"]}
    ]  # fmt: skip
    assert answer["columns"] == [{"name": "qpos/hinge", "noise": 0.001, "given": True}]
    assert 0.5 < answer["noise_inflation"] < 2.0
    assert "viscous_damping on joint hinge" in answer["absorbed_by_psi"]
    assert all(len(group) > 1 for group in answer["open_equivalences"])


def test_check_warns_of_a_fit_that_stalled(study, monkeypatch):
    climb = identifiability.climb
    monkeypatch.setattr(identifiability, "climb", lambda problem: replace(climb(problem), end="stalled"))
    assert "warning: psi: the quick fit stalled where" in run("check", study).stderr


def test_check_without_psi_says_so(tmp_path):
    shown = run("check", make_study(tmp_path / "arm", model_xml(HINGE), "", {"swing": _swing()}).folder)
    assert shown.exit_code == 0 and "The study has no psi" in shown.output


def test_check_names_parameters_that_can_be_traded(tmp_path):
    prior = "prior = { LogNormal = { loc = -4.2, scale = 0.3 } }\n"
    toml = f'[psi.rotor]\ntarget = "joint/hinge/armature"\n{prior}'
    toml += f'[psi.arm]\ntarget = "body/arm/inertia"\nindex = [1]\n{prior}'
    toml += '[noise]\n"qpos/*" = 0.001\n'
    checked = check(make_study(tmp_path / "arm", model_xml(HINGE), toml, {"swing": _swing()}))
    assert {p.name: p.entangled for p in checked.parameters} == {"rotor": ("arm",), "arm": ("rotor",)}


def test_check_of_touching_bodies_leads_simulations_and_compares_no_effects(tmp_path):
    folder = make_study(tmp_path / "slides", sliding.XML.format(0.02), sliding.PSI, sliding.slides()).folder
    shown = run("check", folder, "--json")
    assert shown.exit_code == 0 and "cannot follow" not in shown.stderr
    answer = json.loads(shown.stdout)
    (friction,) = answer["psi"]
    assert answer["contact"] and friction["verdict"] == "identifiable"
    assert abs(friction["mean"] - sliding.TRUTH) < 0.005  # 2e-6 off in this draw, sd 0.0008
    assert 1.0 <= answer["noise_inflation"] < 1.5
    assert "effects were not compared" in run("check", folder).output


def test_check_of_touching_bodies_without_psi(tmp_path):
    """All is known of the model, whose friction is not that of the recordings."""
    noise = sliding.PSI[sliding.PSI.index("[noise]") :]
    folder = make_study(tmp_path / "slides", sliding.XML.format(0.02), noise, sliding.slides()).folder
    shown = run("check", folder)
    assert shown.exit_code == 0 and "The study has no psi" in shown.output


def test_fit_writes_a_file_and_a_summary(study, tmp_path):
    arguments = ("fit", study, "--method", "laplace", "--num-samples", 200, "--out", tmp_path / "out")
    shown = run(*arguments, "--json")
    assert shown.exit_code == 0, shown.output
    answer = json.loads(shown.stdout)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["fit.nc"]
    assert answer["file"] == str(tmp_path / "out" / "fit.nc")
    assert (answer["method"], answer["engine"], answer["seed"]) == ("laplace", "c", 0)
    first = answer["parameters"][0]
    assert first["name"] == "damping"
    assert first["interval"][0] < first["mean"] < first["interval"][1]
    assert first["ess"] > 50
    assert "replaced" not in shown.stderr
    again = run(*arguments)
    assert again.exit_code == 0
    assert f"warning: {tmp_path / 'out' / 'fit.nc'} (laplace, seed 0) is replaced" in again.stderr
    assert f"{first['mean']:.4g}" in again.stdout  # the same seed, and what was there is replaced


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("check", "nowhere"), "error: nowhere: no such folder"),
        (("diagnose", "nowhere", "--out", "out"), "error: nowhere: no such folder"),
        (("fit", "nowhere", "--out", "out"), "error: nowhere: no such folder"),
        (("fit", "nowhere", "--method", "nuts2", "--out", "out"), "error: --method: unknown method 'nuts2'"),
        (("fit", "nowhere", "--engine", "bullet", "--out", "out"), "'bullet' is not one of 'c', 'mjx'"),
        (("fit", "nowhere", "--num-samples", "3", "--out", "out"), "greater than or equal to 4"),
        (("fit", "nowhere"), "Missing option '--out'"),
        (("check", "nowhere", "--seed", "-1"), "--seed"),
        (("effects", "--loud"), "No such option"),
        (("calibrate", "nowhere", "--method", "nuts", "--out", "out"), "error: nowhere: no such folder or problem;"),
        (("calibrate", "no/where", "--method", "nuts", "--out", "out"), "error: no/where: no such folder"),
        (("calibrate", "linear_gausian", "--method", "nuts", "--out", "out"), "did you mean 'linear_gaussian'?"),
        (("calibrate", "linear_gaussian", "--method", "nutz", "--out", "out"), "did you mean 'nuts'?"),
        (("calibrate", "linear_gaussian", "--method", "baseline_cvae", "--out", "out"), "infers no posterior"),
        (
            ("calibrate", "linear_gaussian", "--method", "nuts+psis", "--out", "out"),
            "--method: found 'nuts+psis'",
        ),
        (("fit", "linear_gaussian", "--method", "laplace", "--out", ""), "found ''; allowed: a folder's name"),
        (("compare", "two_moons", "--methods", "npe", "--out", "out"), "which has no recordings: `make compare-sbi`"),
        (("calibrate", "linear_gaussian", "--method", "nuts", "--num-replications", "5", "--out", "out"), "--num-repl"),
    ],
)
def test_an_error_is_clear_and_leaves_nothing(arguments, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = run(*arguments)
    assert shown.exit_code == 2
    assert expected in shown.stderr
    assert "Traceback" not in shown.stderr
    assert not shown.stdout
    assert not list(tmp_path.iterdir())


def test_a_file_in_place_of_a_folder_is_an_error_before_the_work(study, tmp_path):
    (tmp_path / "out").write_text("mine")
    shown = run("fit", study, "--out", tmp_path / "out" / "deep")
    assert shown.exit_code == 2
    assert shown.stderr.startswith(f"error: --out {tmp_path}/out/deep: {tmp_path}/out is a file; allowed:")
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize(
    ("command", "file"),
    [
        (("fit", "--method", "laplace"), "fit.nc"),
        (("compare", "--methods", "laplace"), "report.html"),
        (("compare", "--methods", "laplace"), "runs/laplace.nc"),
        (("calibrate", "--method", "laplace"), "replications.jsonl"),
        (("diagnose",), "diagnosis.json"),
    ],
)
def test_a_folder_in_place_of_a_file_is_an_error_before_the_work(study, tmp_path, monkeypatch, command, file):
    for home, work in ((verbs, "fit"), (verbs, "_drawn"), (verbs_calibrate, "_posed"), (verbs, "diagnose")):
        monkeypatch.setattr(home, work, lambda *_, **__: pytest.fail("it was begun"))
    (tmp_path / "out" / file).mkdir(parents=True)
    shown = run(command[0], study, *command[1:], "--out", tmp_path / "out")
    assert shown.exit_code == 2
    assert shown.stderr.splitlines()[-1].startswith(f"error: {tmp_path}/out/{file}: found a folder")
    assert [p for p in (tmp_path / "out").rglob("*") if p.is_file()] == []


def test_a_diagnosis_does_not_overwrite_the_model_that_it_is_of(tmp_path):
    """A corrected simulator, diagnosed anew where it lies."""
    folder = make_study(tmp_path / "study", model_xml(HINGE), TOML, {"swing": _swing()}).folder
    (folder / "model.xml").rename(folder / "patched.xml")
    (folder / "study.toml").write_text((folder / "study.toml").read_text().replace("model.xml", "patched.xml"))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    shown = run("diagnose", folder, "--out", folder / ".." / "study")
    assert shown.exit_code == 2
    assert "study/patched.xml: is read by the study, and would be overwritten; allowed: another --out" in shown.stderr
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_warnings_of_the_study_are_shown_once_and_of_libraries_never(study, monkeypatch):
    def loaded(folder):
        import warnings

        from det2stoc_bayes.recording import StudyWarning

        for _ in range(2):
            warnings.warn("wrist: looks like degrees [1]", StudyWarning, stacklevel=2)
            warnings.warn("a library's", DeprecationWarning, stacklevel=2)
        raise StudyError("stop here")

    monkeypatch.setattr(cli, "load", loaded)
    shown = run("check", study)
    assert shown.stderr == "warning: wrist: looks like degrees [1]\nerror: stop here\n"


def test_an_unforeseen_error_is_one_line_without_debug(study, monkeypatch):
    def broken(*_, **__):
        raise ValueError("first\nsecond")

    monkeypatch.setattr(identifiability, "check", broken)
    shown = run("check", study)
    assert shown.exit_code == 1
    assert shown.stderr == "unforeseen error: ValueError: first second (--debug shows where)\n"
    assert isinstance(run("check", study, "--debug").exception, ValueError)


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to send")
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_is_one_line(study, sent):
    line = [sys.executable, "-m", "det2stoc_bayes", "fit", str(study), "--out", "never"]
    line += ["--num-samples", "10000000"]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=study)
    assert process.stderr is not None
    assert [process.stderr.readline() for _ in range(2)] == ["fitting by nuts\n", "sampling\n"]
    time.sleep(0.2)
    process.send_signal(sent)
    try:
        out, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert error == "interrupted\n"
    assert not out
    assert not (study / "never").exists()


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to send")
def test_an_interruption_lost_in_a_callback_of_the_garbage_collector_is_raised_again(capfd):
    def interrupt(phase, _):
        if phase == "start":
            gc.callbacks.remove(interrupt)
            signal.raise_signal(signal.SIGINT)

    begun = time.monotonic()
    with pytest.raises(typer.Exit) as left, streams.reporting(debug=False):
        gc.callbacks.append(interrupt)
        gc.collect()
        time.sleep(30)
    assert time.monotonic() - begun < 20
    assert left.value.exit_code == 130
    assert capfd.readouterr().err == "interrupted\n"


def test_an_interruption_that_a_library_lost_ends_the_work_at_its_next_report():
    interrupted = Event()
    stages = progress.Stages(Console(file=StringIO()), interrupted)
    stages("sampling", 1, 3)
    interrupted.set()
    with pytest.raises(KeyboardInterrupt):
        stages("sampling", 2, 3)


def test_effects_lists_the_catalogue():
    from det2stoc_bayes.mismatch.effects import CATALOGUE

    listed = json.loads(run("effects", "--json").stdout)
    forms = [(form.name, form.kind, form.law_text) for e in CATALOGUE.values() for form in e.forms()]
    assert [e["name"] for e in listed] == [name for name, *_ in dict.fromkeys(forms)]
    friction = next(e for e in listed if e["name"] == "coulomb_friction")
    assert friction["law"] == "-F sign(v)"
    assert friction["parameters"] == [{"name": "force", "unit": ["N", "N m"], "size": 1}]
    shown = run("effects").stdout
    assert "force [N or N m]" in shown


def test_progress_is_one_line_a_stage_where_there_is_no_terminal():
    stream = StringIO()
    with progress.Stages(Console(file=stream, force_terminal=False)) as stages:
        for done in range(3):
            stages("screening", done, 2)
            stages.of("refining [1]")(done, 2)
    assert stream.getvalue() == "screening\nrefining [1]\n"


def test_progress_shows_a_bar_on_a_terminal():
    stream = StringIO()
    with progress.Stages(Console(file=stream, force_terminal=True, width=100)) as stages:
        stages("screening", 3, 200)
    assert "screening" in stream.getvalue()
    assert "3/200" in stream.getvalue()


def test_the_package_offers_its_verbs_lazily():
    import det2stoc_bayes

    assert det2stoc_bayes.check is check
    assert issubclass(det2stoc_bayes.StudyError, det2stoc_bayes.Det2StocError)
    assert set(det2stoc_bayes.__all__) <= set(dir(det2stoc_bayes))
    assert det2stoc_bayes.__version__
    with pytest.raises(AttributeError, match="no attribute 'unknown'"):
        det2stoc_bayes.unknown  # noqa: B018


def test_examples_in_help_are_commands_that_exist():
    group = typer.main.get_command(cli.app)
    for name, text in EXAMPLES.items():
        assert text.splitlines()[0] == "\b"  # or its lines would be joined
        for line in text.splitlines()[2:]:
            program, command, *arguments = shlex.split(line)
            assert (program, command) == ("det2stoc", name)
            told = group.commands[name].make_context(name, list(arguments))
            assert told.params


@pytest.mark.parametrize(
    "words, expected",
    [
        ("det2stoc fit S --method n", {"npe", "nuts"}),
        ("det2stoc compare S --methods laplace,n", {"laplace,npe", "laplace,nuts"}),
        ("det2stoc reproduce w", {"windy-slope"}),
        ("det2stoc ser", {"serve"}),
    ],
)
def test_the_shell_completes_names(words, expected):
    env = {"_DET2STOC_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    told = CliRunner().invoke(cli.app, prog_name="det2stoc", env=env)
    assert set(told.stdout.split()) == expected
