"""The teaching notebooks: script and .ipynb are one, they use what is public, and, by `make notebooks`, they run."""

import ast
import importlib
from importlib.util import find_spec
from pathlib import Path

import jupytext
import nbformat
import pytest

import det2stoc_bayes

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "notebooks").glob("*.py"))
EXECUTED = ROOT / "out" / "notebooks"
FEWEST_FIGURES = 3
FIGURES = ("image/png", "application/vnd.plotly.v1+json")


def ids(paths):
    return [path.stem for path in paths]


def headings(notebook):
    return [
        line.lstrip("# ")
        for cell in notebook.cells
        if cell.cell_type == "markdown"
        for line in cell.source.splitlines()
        if line.startswith("#")
    ]


def imported(tree):
    """(module, name or None) of everything that is imported of this package."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names if alias.name.startswith("det2stoc_bayes"))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("det2stoc_bayes"):
            yield from ((node.module, alias.name) for alias in node.names)


def test_there_are_six():
    assert [s.stem[:3] for s in SCRIPTS] == [f"0{n}_" for n in range(1, 7)]


@pytest.mark.parametrize("script", SCRIPTS, ids=ids(SCRIPTS))
def test_the_pair_is_in_sync(script):
    """`make format` pairs them; outputs are not kept."""
    text, paired = jupytext.read(script), nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    assert [(c.cell_type, c.source) for c in text.cells] == [(c.cell_type, c.source) for c in paired.cells]
    code = [c for c in paired.cells if c.cell_type == "code"]
    assert all(not c.outputs and c.execution_count is None for c in code)
    nbformat.validate(paired)


@pytest.mark.parametrize("script", SCRIPTS, ids=ids(SCRIPTS))
def test_it_teaches_and_checks_itself(script):
    notebook = jupytext.read(script)
    found = headings(notebook)
    assert found[0].startswith(f"{int(script.stem[:2])}. ")
    assert {"Exercises", "Answers"} <= set(found)
    assert any("**What to see" in c.source for c in notebook.cells if c.cell_type == "markdown")
    last = ast.parse(notebook.cells[-1].source)
    assert sum(isinstance(node, ast.Assert) for node in ast.walk(last)) >= 3


@pytest.mark.parametrize("script", SCRIPTS, ids=ids(SCRIPTS))
def test_it_uses_what_is_public_and_there(script):
    tree = ast.parse(script.read_text(encoding="utf-8"))
    for module, name in imported(tree):
        assert not any(part.startswith("_") for part in (*module.split("."), name or ""))
        there = hasattr(importlib.import_module(module), name or "__doc__") or find_spec(f"{module}.{name}")
        assert there, f"{module} has no {name}"
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "d2s"
    }
    assert used <= set(det2stoc_bayes.__all__)


@pytest.mark.notebooks
@pytest.mark.timeout(900)
@pytest.mark.parametrize("script", SCRIPTS, ids=ids(SCRIPTS))
def test_it_runs_and_shows_its_figures(script, tmp_path):
    """Its own assertions hold what its text claims. The executed copy stays in out/notebooks to be looked at."""
    from nbclient import NotebookClient

    notebook = jupytext.read(script)
    told = notebook.copy()
    try:
        NotebookClient(
            told, timeout=800, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
        ).execute()
    finally:
        EXECUTED.mkdir(parents=True, exist_ok=True)
        nbformat.write(told, EXECUTED / f"{script.stem}.ipynb")
    shows = [
        c for c in told.cells if c.cell_type == "code" and ("plt.show()" in c.source or "figure.show()" in c.source)
    ]
    assert len(shows) >= FEWEST_FIGURES
    for cell in shows:
        shown = [kind for output in cell.outputs for kind in output.get("data", {})]
        assert any(kind in FIGURES for kind in shown), cell.source
