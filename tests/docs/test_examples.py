"""What the documentation shows is run: its examples, and the commands that it prints."""

import importlib.util
import re
import shlex
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest
import typer.main
from conftest import ARM, make_study, model_xml
from simulated import pose

from det2stoc_bayes import cli
from det2stoc_bayes.inference import laplace
from det2stoc_bayes.mismatch.effects import PlacedEffect, Typical
from det2stoc_bayes.mismatch.patch_module import module_text
from det2stoc_bayes.models import get_problem, linear_gaussian
from det2stoc_bayes.study import load_study

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TIME = np.arange(41) * 0.02


def example(name):
    """A file of docs/examples as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """An arm let go, as a problem; its own motion is its recording."""
    columns = {
        "qpos/shoulder": 0.4 + 0 * TIME,
        "qpos/elbow": 0 * TIME,
        "qvel/shoulder": 0 * TIME,
        "qvel/elbow": 0 * TIME,
    }
    folder = tmp_path_factory.mktemp("studies") / "arm"
    return pose(make_study(folder, model_xml(ARM), recordings={"swing": (TIME, columns)}))


def test_the_effect_is_its_law(swing):
    """The engine's motion beside a plain loop; measured: the same to 1e-12."""
    effect, size = example("cubic_damping").CubicDamping(), 0.05
    found = example("try_effect").predicted(swing, effect, {"coefficient": size})[0]
    model = mujoco.MjModel.from_xml_path(str(swing.simulator.study.model_path))
    data, rows = mujoco.MjData(model), []
    data.qpos[0] = 0.4
    for k in range(len(TIME) * 10):
        if k % 10 == 0:
            rows.append(np.concatenate([data.qpos, data.qvel]))
        data.qfrc_applied[0] = -size * data.qvel[0] ** 3
        mujoco.mj_step(model, data)
    order = [["qpos/shoulder", "qpos/elbow", "qvel/shoulder", "qvel/elbow"].index(c) for c in swing.segments.columns]
    np.testing.assert_allclose(found, np.array(rows)[:, order], atol=1e-8)
    without = example("try_effect").predicted(swing, effect, {"coefficient": 0.0})[0]
    assert np.abs(found - without).max() > 0.01


def test_the_effect_goes_into_effects_py(swing):
    from det2stoc_bayes.engines.elements import joint_elements

    effect = example("cubic_damping").CubicDamping()
    placed = PlacedEffect(effect, joint_elements(swing.simulator.model)[0], Typical())
    text = module_text([(placed, {"coefficient": 0.05})])
    assert text is not None and "def cubic_damping_joint_force" in text
    assert effect.priors(Typical(force=2.0, speed=2.0))["coefficient"].sd == pytest.approx(0.3 * 2 / 8)


def test_the_method_draws_the_posterior():
    problem = get_problem("linear_gaussian")
    tree = example("resampled_prior").fit(problem, 0, num_samples=2000, num_proposed=4000)
    mean, covariance = linear_gaussian.exact_posterior(problem)
    for k, name in enumerate(("gravity_x", "gravity_z")):
        draws, sd = tree.posterior[name].values.ravel(), np.sqrt(covariance[k, k])
        assert abs(draws.mean() - mean[k]) < 4 * sd / np.sqrt(1000)  # more than half are different ones
        assert draws.std() == pytest.approx(sd, rel=0.1)
    assert tree.attrs["method"] == "resampled_prior" and tree.attrs["simulations"] >= 4000


def test_the_system_is_a_study(tmp_path):
    module = example("damped_spring")
    study = load_study(module.record(tmp_path / "spring"))
    tree = laplace.fit(pose(study), 0, num_samples=400)
    for name, truth in module.TRUTH.items():
        draws = tree.posterior[name].values
        assert abs(float(draws.mean()) - truth) < 4 * float(draws.std())
        assert float(draws.std()) < 0.8 * next(p.prior.sd for p in study.parameters if p.name == name)


def blocks(language):
    """(page, text) of every block of a language."""
    for page in PAGES:
        for text in re.findall(
            rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
        ):
            yield page.name, text


AS_RUN = ("measurements.md", "measurements_earlier.md", "bad_input.md")  # what was run of old commits stays as it was


def commands():
    """Every `det2stoc ...` that is printed, in blocks and in lines, as words."""
    found = [(page, line) for page, text in blocks("sh") for line in text.replace("\\\n", " ").splitlines()]
    for page in PAGES:
        if page.name not in (
            "measurements.md",
            "measurements_earlier.md",
            "bad_input.md",
        ):  # what was run of old commits stays as it was
            found += [
                (page.name, m) for m in re.findall(r"`(det2stoc [a-z]+ [^`\n|]*--[^`\n|]*)`", page.read_text("utf-8"))
            ]
    for page, line in found:
        line = line.split("#")[0].strip()
        if line.startswith("det2stoc ") and "--help" not in line:
            yield page, shlex.split(line.replace("...", ""))


def test_printed_commands_and_options_exist():
    group = typer.main.get_command(cli.app)
    seen = set()
    for page, words in commands():
        command, rest = group, words[1:]
        while rest and hasattr(command, "commands"):
            command, rest = command.commands.get(rest[0]), rest[1:]
        assert command is not None, f"{page}: {words}"
        options = {flag for parameter in command.params for flag in (*parameter.opts, *parameter.secondary_opts)}
        given = {word.split("=")[0] for word in words if word.startswith("--")}
        assert given <= options, f"{page}: {' '.join(words)}"
        seen.add(words[1])
    assert {"check", "fit", "diagnose", "compare", "calibrate", "blind", "export"} <= seen


def test_printed_python_and_toml_are_valid():
    texts = list(blocks("python"))
    assert len(texts) >= 5
    for page, text in texts:
        compile(text, page, "exec")
    for _, text in blocks("toml"):
        tomllib.loads(text)


def test_make_targets_that_are_printed_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for page, text in blocks("sh"):
        for line in text.splitlines():
            if line.startswith("make "):
                assert re.search(rf"^{line.split()[1]}:", makefile, re.MULTILINE), f"{page}: {line}"
