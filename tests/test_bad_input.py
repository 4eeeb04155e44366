"""Bad input: one line that says what to mend, exit code 2 or a warning, nothing written."""

import re
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from bad_input import CASES, Case, outcome, row

from det2stoc_bayes import identifiability
from det2stoc_bayes.mismatch.open_equivalences import OpenEquivalences

DOCUMENT = Path(__file__).parents[1] / "docs/bad_input.md"


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.kind)
def test_it_is_refused_or_warned_of(case: Case, tmp_path, monkeypatch):
    # What effects look alike takes long, and is told of the study that is fine.
    monkeypatch.setattr(identifiability, "open_equivalences", lambda *_: OpenEquivalences((), ()))
    code, said = outcome(case, tmp_path)
    assert code == (2 if case.error else 0), said
    errors = [line for line in said if not line.startswith("warning: ")]
    assert len(errors) == case.error and said
    assert all(line.startswith("error: ") and "allowed: " in line or "compile" in line for line in errors)
    assert all(len(number) < 25 for line in said for number in re.findall(r"\d+", line))
    assert _words(row(case, code, said, tmp_path)) in [_words(line) for line in DOCUMENT.read_text().splitlines()]


def _words(line: str) -> str:
    """Without the figures of a quick fit, whose last digits hang on the machine."""
    return re.sub(r"[\d.e+-]+(?=%| noise sds)", "#", line)


@pytest.mark.parametrize("case", [c for c in CASES if c.error][::9], ids=lambda case: case.kind)
def test_a_diagnosis_refuses_it_too(case: Case, tmp_path):
    code, said = outcome(case, tmp_path, "diagnose")
    assert code == 2 and said[-1].startswith("error: ")


def test_a_study_that_is_fine_is_told_nothing(tmp_path):
    assert outcome(Case("nothing", lambda folder: None, error=False), tmp_path) == (0, [])


def test_the_document_has_every_kind():
    text = DOCUMENT.read_text()
    assert len(CASES) >= 25
    assert [case.kind for case in CASES if f"| {case.kind} |" not in text] == []
