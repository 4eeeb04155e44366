"""Many concealed cases: what is drawn, what a diagnosis is given, how a run is interrupted and goes on, its page."""

import json
import os
import pickle
import time
from concurrent.futures import Executor, Future
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from det2stoc_bayes import cli
from det2stoc_bayes.blind import proof
from det2stoc_bayes.blind.child import diagnosed
from det2stoc_bayes.blind.conceal import ConcealedCase, make_case
from det2stoc_bayes.blind.draw import KINDS, TOUCHING, Choice, draws, mixture
from det2stoc_bayes.blind.page import proof_page
from det2stoc_bayes.blind.summary import row, summarize
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.report.glimpse import glimpse

LOG = Path(__file__).parents[2] / "benchmarks" / "results" / "concealed.jsonl"
SECRET = "coulomb_friction"
TOLD = """
import json, os, pathlib, sys, time
study, out = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[3])
content = (study / "study.toml").read_text()
with (pathlib.Path(__file__).parent / "ran").open("a") as ran:
    ran.write(f"{os.getpid()} {content}\\n")
time.sleep(float(content.split()[1]))
if content.split()[0] == "1":
    sys.exit("broken")
seen = sorted(str(p.relative_to(study.parent)) for p in study.parent.rglob("*") if p.is_file())
here = os.getcwd() == str(study.parent)
out.mkdir()
diagnosis = {"verdict": "no_mismatch", "summary": json.dumps([seen, here, sys.argv]), "effects": [], "candidates": []}
(out / "diagnosis.json").write_text(json.dumps(diagnosis | {"psi": {}}))
"""


def case(index, seconds=0.0):
    files = {"study.toml": f"{index} {seconds}", "recordings/rec_01.csv": "time\n"}
    truth = {"name": SECRET, "element": {"kind": "joint", "name": "rail"}, "parameters": {"force": 1.0}}
    return ConcealedCase(7 + index, files, {"verdict": "mismatch", "system": "slider", "effects": [truth], "psi": {}})


def quick(seed, kind, index, choice):
    return case(index)


def slow_but_for_the_first(seed, kind, index, choice):
    return case(2 * index, 60.0 * (index > 0))


def tiny(seed, kind, index, choice):
    return make_case(2, system="slider", control=True, num_recordings=2, num_samples=60)


def impossible(seed, kind, index, choice):
    raise ValueError("an effect: concealed in none of 100 drawn systems")


@pytest.fixture
def told(tmp_path):
    """A program in the place of a diagnosis: what it is given it says, and case 1 it does not survive."""
    script = tmp_path / "told" / "told.py"
    script.parent.mkdir()
    script.write_text(TOLD)
    return script


def ran(script):
    path = script.parent / "ran"
    return len(path.read_text().splitlines()) if path.is_file() else 0


def run(script, log, count=4, choice=None, **options):
    options = {"seed": "ab12", "commit": "c0", "draw": quick, "arguments": (str(script),)} | options
    return proof.run({"effect": count}, choice or Choice(), log, **options)


def test_what_was_drawn_for_a_seed_is_drawn_again():
    """The systems, variants and numbers of every logged case."""
    lines, other = proof.read(LOG)
    assert len(lines) >= 500 and other == 26  # of an older format
    for line in lines:
        if line["kind"] in ("effect", "pair", "control"):
            told = line["choice"]
            choice = Choice(tuple(told["systems"]), told["plain"], tuple(told.get("names", ())))
            every = draws(line["seed"], line["kind"], line["index"], choice)
            found = next(d for d in every if d["seed"] == line["case_seed"])
            assert (found["system"], list(found["variants"])) == (line["answer"]["system"], line["answer"]["variants"])


def test_kinds_of_cases():
    numbers = [kind.number for kind in KINDS.values()]
    assert len(set(numbers)) == len(numbers) and {k: KINDS[k].number for k in ("effect", "pair", "control")} == {
        "effect": 0, "pair": 1, "control": 2,
    }  # fmt: skip
    (short,) = islice(draws("0", "short_control", 0, Choice()), 1)
    assert short["control"] and short["num_samples"] < 100 and short["system"] not in TOUCHING
    found = [d for i in range(3) for d in draws("0", "contact", i, Choice(("slider", "puck", "ball")))]
    assert {d["system"] for d in found} == {"puck"}
    assert {v for d in found for v in d["variants"]} == {"positions_only", "varying_psi"}
    assert {d["system"] for d in draws("0", "contact", 0, Choice(("slider",)))} == set(TOUCHING)
    for kind in ("effect", "contact"):
        (named,) = islice(draws("0", kind, 3, Choice(names=("armature", "tether"))), 1)
        assert named["effect"] == "tether"


@pytest.mark.parametrize("studies", [1, 7, 20, 60, 61])
def test_a_mixture_has_as_many_studies_as_asked_for(studies):
    assert sum(mixture(studies).values()) == studies and mixture(60)["control"] == 12


def test_a_diagnosis_sees_the_study_alone_and_its_end_is_told(told, tmp_path):
    lines = run(told, tmp_path / "log.jsonl", 2)
    seen, here, words = json.loads(lines[0]["diagnosis"]["summary"])
    assert seen == ["said", "study/recordings/rec_01.csv", "study/study.toml"] and here
    assert [Path(word).name for word in words[1:]] == ["study", "--out", "out"] and SECRET not in "".join(words)
    assert lines[0]["seconds"] > 0.0 and lines[0]["peak_mb"] > 1.0 and lines[0]["case_seed"] == 7
    assert lines[1]["diagnosis"] == {"verdict": "failed (1)", "error": "broken\n"}
    scored = row(json.loads(json.dumps(lines[1])))
    assert not scored.score.named and not scored.score.false_claim


def test_an_interrupted_run_goes_on(told, tmp_path):
    log = tmp_path / "results" / "log.jsonl"

    def interrupting(stage, done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(told, log, progress=interrupting)
    assert ran(told) == 2 and len(log.read_text().splitlines()) == 2
    log.write_text(log.read_text() + '{"kind": "effect", "index": 2, "cut')
    lines = run(told, log)
    assert ran(told) == 4 and [line["index"] for line in lines] == [0, 1, 2, 3]
    assert len(log.read_text().splitlines()) == 4
    assert run(told, log) == lines and ran(told) == 4
    run(told, log, 1, commit="c1")  # another commit is another run
    run(told, log, 1, choice=Choice(("slider",), plain=True))  # and so is another choice of cases
    assert ran(told) == 6
    assert len(proof.read(log)[0]) == 6


def test_an_interruption_ends_the_processes_and_keeps_what_they_found(told, tmp_path):
    log = tmp_path / "log.jsonl"

    def interrupting(stage, done, total):
        if done == 1:
            raise KeyboardInterrupt

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run(told, log, draw=slow_but_for_the_first, jobs=2, progress=interrupting)
    assert time.monotonic() - began < 40 and len(log.read_text().splitlines()) == 1
    kept, here = json.loads(log.read_text()), run(told, tmp_path / "here.jsonl", 1)[0]
    for line in (kept, here):
        assert line.pop("seconds") > 0 and line.pop("peak_mb") > 0 and line["diagnosis"].pop("summary")
    assert kept == here
    pids = [int(line.split()[0]) for line in (told.parent / "ran").read_text().splitlines()]
    for _ in range(100):
        if not any(Path(f"/proc/{pid}").exists() for pid in pids):
            break
        time.sleep(0.1)
    assert pids and not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_what_cannot_be_concealed_is_an_error(told, tmp_path):
    with pytest.raises(Det2StocError, match="effect 0: an effect: concealed in none of 100 drawn systems; allowed"):
        run(told, tmp_path / "log.jsonl", 1, draw=impossible)


class Recording(Executor):
    """Keeps what it is sent."""

    def __init__(self):
        self.sent = b""

    def submit(self, fn, /, *args, **kwargs):
        self.sent, future = pickle.dumps((fn, args, kwargs)), Future()
        future.set_result(fn(*args, **kwargs))
        return future


def test_an_answer_does_not_travel(told):
    away = Recording()
    found = proof.sent(away, diagnosed, case(0).encoded(), (str(told),))
    assert found.diagnosis["verdict"] == "no_mismatch" and b"study.toml" in away.sent
    assert SECRET.encode() not in away.sent and b"rail" not in away.sent


def test_a_diagnosis_that_does_not_end_is_a_failure(told, monkeypatch):
    monkeypatch.setattr("det2stoc_bayes.blind.child.LIMIT", 1.0)
    found = diagnosed(case(0, 60.0).encoded(), (str(told),))
    assert found.diagnosis["verdict"] == "failed (-9)" and found.diagnosis["error"].startswith("killed after 1 s")
    assert found.seconds < 20.0


def test_a_small_study_from_end_to_end(tmp_path):
    lines = proof.run({"control": 1}, Choice(), tmp_path / "log.jsonl", seed="1", draw=tiny)
    assert lines[0]["diagnosis"]["verdict"] == "no_mismatch", lines[0]["diagnosis"]
    shown = lines[0]["rollout"]
    assert shown["recording"].startswith("hold") and shown["channel"] in ("qpos/rail", "qvel/rail")
    assert len(shown["time"]) == len(shown["observed"]) == len(shown["before"]) == 60
    page = proof_page(lines, [row(line) for line in lines], summarize([row(line) for line in lines]))
    assert "0 false alarms in 1 with nothing concealed" in page and 'id="case-1"' in page


def test_a_glimpse_is_of_the_worst_held_out_column(tmp_path):
    def rollout(role, scale):
        values = np.outer(np.arange(500.0), [0.1, scale])
        data = dict.fromkeys(("observed", "before", "residual_before"), (("sample", "channel"), values))
        return xr.Dataset(data, {"channel": ["a", "b"], "time": ("sample", 0.01 * np.arange(500))}, {"role": role})

    groups = {"/rollouts/rec_1": rollout("fitted", 9.0), "/rollouts/hold_1": rollout("holdout", 1.0)}
    tree = xr.DataTree.from_dict(groups)
    tree.to_netcdf(tmp_path / "fit.nc", engine="h5netcdf")
    shown = glimpse(tmp_path / "fit.nc")
    assert shown is not None and (shown["recording"], shown["channel"], len(shown["time"])) == ("hold_1", "b", 120)
    assert shown["time"][-1] == 4.99 and shown["before"][-1] == 499.0 and "after" not in shown


def invoke(*arguments):
    return CliRunner().invoke(cli.app, ["blind", *map(str, arguments)])


def test_a_log_is_scored_anew(tmp_path):
    lines = [line for line in LOG.read_text("utf-8").splitlines()[-60:] if '"kind"' in line]
    log = tmp_path / "some.jsonl"
    log.write_text("\n".join([*lines, '{"kind": "cut', '{"else": 1}']))
    shown = invoke("--rescore", log, "--out", tmp_path / "out", "--json")
    assert shown.exit_code == 0, shown.output
    told = json.loads(shown.stdout)
    assert len(told["cases"]) == len(lines) == told["kinds"][-1]["cases"]
    assert told == json.loads((tmp_path / "out" / "blind.json").read_text())
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<details") == len(lines) and "http:" not in page.split("<script>")[0]
    assert page.rfind("<details open>") < page.find("<details>")  # failures first
    seeds = {json.loads(line)["seed"] for line in lines}
    one = invoke("--rescore", log, "--out", tmp_path / "one", "--seed", min(seeds))
    assert one.exit_code == 0 and "concealed studies" in one.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--rescore", "nowhere.jsonl"), "--rescore nowhere.jsonl: no such file"),
        (("--rescore", os.devnull), "no such file"),
        (("--rescore", __file__), "none of which is a case"),
        (("--seed", "xyz"), "--seed: found 'xyz'; allowed: 1 to 40 hexadecimal digits"),
        (("--systems", "pendulumm"), "--systems: found 'pendulumm'; did you mean 'pendulum'?"),
        (("--names", "coulomb"), "--names: found 'coulomb'; did you mean 'coulomb_friction'?"),
        (("--studies", "0"), "--studies, --effects and the like: found 0 in all"),
        (("--effects", "0", "--cluster", "here"), "found 0 in all"),
        (("--effects", "1", "--cluster", "here"), "--cluster: found 'here'"),
    ],
)
def test_bad_input_is_one_line(arguments, said, tmp_path):
    shown = invoke(*arguments, "--out", tmp_path / "out")
    assert shown.exit_code == 2 and "Traceback" not in shown.output
    assert shown.output.splitlines()[-1].startswith("error: ") and said in shown.output.splitlines()[-1]
    assert not (tmp_path / "out" / "report.html").exists()
