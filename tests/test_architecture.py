"""The rules of who may import what, read from the source without running it."""

import ast
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

import det2stoc_bayes
from det2stoc_bayes import models

ROOT = Path(__file__).parents[1]
EDGE = (
    "cli.py",
    "cli_blind.py",
    "cli_given.py",
    "cli_import.py",
    "cli_serve.py",
    "streams.py",
    "verbs.py",
    "verbs_calibrate.py",
    "tables.py",
    "finding_tables.py",
    "__main__.py",
)  # the outermost layer, which may know everything
ONLY_IN = {
    "mujoco": ("simulator.py", "engines/", "mismatch/patch", "mismatch/mjcf", "models/", "blind/"),
    "blackjax": ("inference/",),
    "emcee": ("inference/",),
    "flowjax": ("inference/",),
    "xarray": ("posterior.py", "comparison.py", "report/", "mismatch/result.py", "mismatch/replay.py"),
    "arviz": ("posterior.py", "comparison.py", "psis.py", "report/", "mismatch/result.py"),
}
MOST_LINES = 300


def _files() -> dict[str, Path]:
    """Every module by its path in the package; models and inference stand at the repository's top."""
    package = ROOT / "det2stoc_bayes"
    linked = ("models", "inference")
    found = {
        path.relative_to(package).as_posix(): path
        for path in sorted(package.rglob("*.py"))
        if path.relative_to(package).parts[0] not in linked
    }
    return found | {
        path.relative_to(ROOT).as_posix(): path for name in linked for path in sorted((ROOT / name).rglob("*.py"))
    }


FILES = _files()
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in FILES.items()}


def _is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def _running(node: ast.AST, *, functions: bool = True) -> Iterator[ast.AST]:
    """What runs: all below a node but `if TYPE_CHECKING`; without `functions`, what runs at import."""
    for child in ast.iter_child_nodes(node):
        if _is_for_types(child):
            continue
        if not functions and isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        yield child
        yield from _running(child, functions=functions)


def _imports(name: str) -> list[tuple[int, str]]:
    """Line and full dotted name of everything that a file imports, inside its functions too."""
    found = []
    for node in _running(TREES[name]):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            home = ["det2stoc_bayes", *Path(name).parts[: -node.level]] if node.level else []
            module = ".".join([*home, node.module] if node.module else home)
            found += [(node.lineno, f"{module}.{alias.name}") for alias in node.names]
    return found


def _violations(names: list[str], *forbidden: str) -> list[str]:
    return [
        f"{name}:{line} imports {imported}"
        for name in names
        for line, imported in _imports(name)
        if any(imported == f or imported.startswith(f"{f}.") for f in forbidden)
    ]


def _in(folder: str) -> list[str]:
    return [name for name in FILES if name.startswith(f"{folder}/")]


FRAME = [name for name in FILES if not name.startswith(("models/", "inference/")) and name not in EDGE]


def test_the_frame_knows_no_system_and_no_method():
    # The blind proof makes its own systems; the reproduced experiments bring systems and methods together.
    frame = [name for name in FRAME if not name.startswith(("blind/", "reproduce/"))]
    assert not _violations(frame, "det2stoc_bayes.models", "det2stoc_bayes.inference")


def test_models_and_methods_do_not_know_each_other():
    assert not _violations(_in("models"), "det2stoc_bayes.inference")
    assert not _violations(_in("inference"), "det2stoc_bayes.models")


def test_problems_are_the_models_that_pose_one():
    """`models` names them, since to look for them would import them all."""
    posed = {"record": set(), "PROBLEM": set()}
    for name in set(_in("models")) - {"models/__init__.py"}:
        for node in TREES[name].body:
            told = {node.name} if isinstance(node, ast.FunctionDef) else set()
            told |= {ast.unparse(t) for t in node.targets} if isinstance(node, ast.Assign) else set()
            for kind in posed.keys() & told:
                posed[kind].add(Path(name).stem)
    assert posed == {"record": set(models.PROBLEMS), "PROBLEM": set(models.VECTORS)}


def test_nothing_builds_on_the_command_line():
    inner = [name for name in FILES if name not in EDGE]
    assert not _violations(inner, *(f"det2stoc_bayes.{name.removesuffix('.py')}" for name in EDGE))


def test_no_module_hides_a_public_name():
    """`import det2stoc_bayes.x` would put the module in the place of a function x."""
    assert not [n for n in det2stoc_bayes.__all__ if n.islower() and find_spec(f"det2stoc_bayes.{n}")]


def test_models_and_inference_are_imported_by_their_full_name():
    assert not _violations(list(FILES), "models", "inference")


def test_the_detector_does_not_know_the_blind_proof():
    assert not _violations([n for n in FRAME if not n.startswith("blind/")], "det2stoc_bayes.blind")


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_library_stays_where_it_belongs(library):
    elsewhere = [name for name in FILES if not name.startswith(ONLY_IN[library])]
    parts = [f"{library}_{part}" for part in ("base", "stats", "plots")] if library == "arviz" else []
    assert not _violations(elsewhere, library, *parts)


@pytest.mark.parametrize("name", FILES)
def test_importing_sets_nothing(name):
    """JAX's configuration and the environment are set by who runs, or inside a function that says so."""
    source = [ast.unparse(n) for n in _running(TREES[name], functions=False) if isinstance(n, ast.stmt)]
    settings = (
        "jax.config.",
        "config.update(",
        "numpyro.enable_x64",
        "os.environ[",
        "os.environ.set",
        "os.putenv",
    )
    assert not [line for line in source if line.startswith(settings)]


def test_files_stay_short():
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in FILES.items()}
    assert not {name: count for name, count in lines.items() if count > MOST_LINES}


@pytest.mark.parametrize(
    ("source", "imported"),
    [
        ("import mujoco.mjx", "mujoco.mjx"),
        ("def f():\n    from det2stoc_bayes import models", "det2stoc_bayes.models"),
        ("from . import text", "det2stoc_bayes.blind.text"),
        ("from ..study import Study", "det2stoc_bayes.study.Study"),
    ],
)
def test_the_rules_see_an_import(source, imported, monkeypatch):
    monkeypatch.setitem(TREES, "blind/made.py", ast.parse(source))
    assert [name for _, name in _imports("blind/made.py")] == [imported]


def test_the_rules_overlook_what_is_for_types_alone(monkeypatch):
    source = "if TYPE_CHECKING:\n    import mujoco\nelse:\n    pass"
    monkeypatch.setitem(TREES, "study.py", ast.parse(source))
    assert not _imports("study.py")
