"""The benchmark of concealed studies: its log, its going on after an interruption, its cases."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from det2stoc_bayes.blind.conceal import make_case

PATH = Path(__file__).parents[2] / "benchmarks" / "concealed.py"
NO_ALARM = {"verdict": "no_mismatch", "effects": [], "candidates": [], "psi": {}}
COUNTS = {"effect": 0, "pair": 0, "control": 3}


@pytest.fixture
def bench(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location("concealed_benchmark", PATH)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "LOG", tmp_path / "results" / "log.jsonl")
    case = make_case(1, system="slider", control=True, num_recordings=1, num_samples=30)
    monkeypatch.setattr(module, "draw_case", lambda seed, kind, index, choice: case)
    return module


def test_an_interrupted_run_goes_on(bench, monkeypatch):
    asked = []

    def interrupted(case):
        asked.append(case.seed)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return NO_ALARM, 1.5, 200.0

    monkeypatch.setattr(bench, "diagnosed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        bench.run("ab12", COUNTS, "c0", 1, bench.Choice())
    with bench.LOG.open("a") as log:
        log.write('{"seed": "ab12", "cut')
    with bench.LOG.open("a") as log:
        log.write("\n")
    before = len(bench.LOG.read_text().splitlines())
    asked.clear()
    monkeypatch.setattr(bench, "diagnosed", lambda case: (asked.append(case.seed), (NO_ALARM, 1.5, 200.0))[1])
    rows = bench.run("ab12", COUNTS, "c0", 1, bench.Choice())
    assert len(rows) == 3 and len(asked) == 4 - before and all(score.named for _, score, _, _ in rows)
    bench.run("ab12", COUNTS, "c0", 1, bench.Choice())
    assert len(asked) == 4 - before
    bench.run("ab12", {**COUNTS, "control": 1}, "c1", 1, bench.Choice())
    assert len(asked) == 5 - before  # another commit is another run
    bench.run("ab12", {**COUNTS, "control": 1}, "c1", 1, bench.Choice(("slider",), plain=True))
    assert len(asked) == 6 - before  # and so is another choice of cases


def test_a_diagnosis_sees_the_study_alone_and_its_end_is_told(bench, monkeypatch, tmp_path):
    script = tmp_path / "python"
    body = "import json,os,sys,pathlib; out=pathlib.Path(sys.argv[6]); out.mkdir(); study=pathlib.Path(sys.argv[4]);"
    body += "found=sorted(p.name for p in study.iterdir()); around=sorted(p.name for p in study.parent.iterdir());"
    body += "(out/'diagnosis.json').write_text(json.dumps({'verdict':'no_mismatch','found':found,'around':around}))"
    script.write_text(f'#!/bin/sh\nexec {sys.executable} -c "{body}" "$@"\n')
    script.chmod(0o755)
    monkeypatch.setattr(bench.sys, "executable", str(script))
    diagnosis, seconds, megabytes = bench.diagnosed(bench.draw_case("1", "control", 0, bench.Choice()))
    assert diagnosis["found"] == ["holdout", "model.xml", "recordings", "study.toml"]
    assert set(diagnosis["around"]) <= {"study", "out", "said"}
    assert seconds > 0.0 and megabytes > 1.0  # a child starts with its parent's peak
    script.write_text("#!/bin/sh\necho broken\nexit 3\n")
    failed, _, _ = bench.diagnosed(bench.draw_case("1", "control", 0, bench.Choice()))
    assert failed["verdict"] == "failed (3)" and failed["error"] == "broken\n"
    line = bench.one("1", "control", 0, "c0", bench.Choice())
    assert not bench.scored(json.loads(json.dumps(line))).named
