"""patched.xml with effects.py, run by a plain MuJoCo loop, against the engine that fitted them."""

import ast
import importlib.util
import itertools
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from catalogue import AIR, FORMS, VALUES, place_form
from conftest import ARM, FREE, MOTORS, blank_recording, make_study, model_xml, state_columns

from det2stoc_bayes.engines.base import EffectRows, Request, Start
from det2stoc_bayes.mismatch.effects import CATALOGUE, Effect, EffectParameter, PlacedEffect, Typical
from det2stoc_bayes.mismatch.patch import make_patch
from det2stoc_bayes.mismatch.patch_module import FieldWrite, module_text
from det2stoc_bayes.segments import cut, from_pieces
from det2stoc_bayes.simulator import Simulator

DT, TIME = 0.002, np.arange(81) * 0.01  # 400 steps
SENSORS = '<sensor><jointpos name="angle" joint="elbow"/><gyro name="spin" site="tip"/></sensor>'
ARM_TIP = ARM.replace('name="lower" pos="0.3 0 0">', 'name="lower" pos="0.3 0 0"><site name="tip"/>')
LOCAL_NUMBER = itertools.count()


WHOLE = 1.0


def part(delay: float, share: float) -> float:
    """A law's helper, with types that effects.py does not have."""
    return WHOLE * share * delay


class LateColumn(Effect):
    """A column that comes late: a law with helpers, in the hook that looks back on the motion."""

    name, kind, law, law_text = "late_column", "sensor", r"y(t - \tau)", "y(t - delay)"
    parameters = (EffectParameter("delay", "s"),)
    share = 1.0

    def _shift(self, p):
        return part(p["delay"], self.share)[..., None]

    def sample_time(self, p, t, xp):
        """Earlier."""
        return t - self._shift(p)


def load(text, folder):
    """The module of a text."""
    name = f"effects_{next(LOCAL_NUMBER)}"
    path = folder / f"{name}.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def plain_loop(patch, folder, segments, start, replay=0, states=None):
    """The samples of a caller who knows the contract; `replay`: steps before, with `states` written in."""
    model = mujoco.MjModel.from_xml_string(patch.model)
    data, effects = mujoco.MjData(model), load(patch.module, folder) if patch.module else None
    dt = model.opt.timestep
    num_steps = int(segments.steps(dt)[0])
    commands = segments.commands(np.zeros(1, int), dt, num_steps, replay).each[0]
    if effects:
        effects.reset(model, data)
    data.time = segments.time[0, 0] - replay * dt
    out = []
    for k in range(-replay, num_steps + 1):
        if k <= 0:
            data.qpos[:], data.qvel[:] = (start.qpos[0], start.qvel[0]) if k == 0 else states[k]
        at = (segments.time[0] - segments.time[0, 0]) / dt
        if k >= 0 and np.abs(at - k).min() < 1e-6:
            out.append(read(model, data, segments.columns, effects))
        if k == num_steps:
            break
        data.ctrl[:] = commands[k + replay]
        data.qfrc_applied[:], data.xfrc_applied[:] = 0.0, 0.0
        if effects:
            effects.control(model, data)
        mujoco.mj_step(model, data)
    return np.array(out)


def read(model, data, columns, effects):
    """What effects.py measures, or the plain values."""
    if effects:
        recorded = effects.measure(model, data, list(columns))
        return [recorded[c] for c in columns]
    copy = mujoco.MjData(model)
    copy.qpos[:], copy.qvel[:], copy.ctrl[:] = data.qpos, data.qvel, data.ctrl
    mujoco.mj_forward(model, copy)
    # The columns of the tests' models in their own order: positions, velocities, sensors.
    values = {f"qpos/{model.joint(j).name}": copy.qpos[j] for j in range(model.njnt)}
    values |= {f"qvel/{model.joint(j).name}": copy.qvel[j] for j in range(model.njnt)}
    values |= {"sensor/angle": copy.sensordata[0], "sensor/spin/1": copy.sensordata[2]}
    return [values[c] for c in columns]


def placed(effect, simulator, columns):
    """On the second element that fits, with values that show."""
    found = simulator.elements(effect.kind, columns)
    if not found:
        pytest.skip(f"the simulator names no element for {effect.name}")
    return PlacedEffect(effect, found[min(1, len(found) - 1)], Typical())


def rollout(simulator, segments, start, effects, **options):
    """The engine's samples."""
    rows = tuple(EffectRows.alike(p, 1, values) for p, values in effects)
    fields = simulator.fields(simulator.believed[None], ["blank"])
    return simulator.rollout(Request(segments, np.zeros(1, int), start, fields, rows, **options))[0]


def setting(tmp_path, integrator, time=TIME):
    """An arm with two joints, two motors and sensors in moving air, some commands and a start."""
    xml = model_xml(ARM_TIP, MOTORS + SENSORS, option=AIR.format(integrator))
    study = make_study(tmp_path / "study", xml)
    simulator = Simulator(study, num_threads=1)
    ctrl = 0.5 + np.sin(np.outer(time, [9.0, 7.0]))
    columns = (*state_columns(simulator.model), "sensor/angle", "sensor/spin/1")
    recording = blank_recording(simulator.model, time, columns, ctrl)
    return (
        study,
        simulator,
        recording,
        Start(np.array([[0.4, -0.3]]), np.array([[1.0, -2.0]]), np.zeros((1, 0))),
    )


def check_reproduced(tmp_path, effects, integrator, first=0, least=1e-4, **options):
    """Texts and engine move alike, and the effects matter."""
    study, simulator, recording, start = setting(tmp_path, integrator)
    segments = cut([recording])
    listed = [(e if isinstance(e, PlacedEffect) else placed(e, simulator, segments.columns), v) for e, v in effects]
    fitted = rollout(simulator, segments, start, [x for x in listed if x[0].element.kind != "simulator"], **options)
    patch = make_patch(study, {}, listed)
    moved = plain_loop(patch, tmp_path, segments, start)
    assert moved.shape == fitted.shape
    error = np.abs(moved - fitted)[first:].max()
    print(f"{[p.label for p, _ in listed]} {integrator}: {error:.1e}")
    assert error < 1e-9
    assert np.abs(fitted - rollout(simulator, segments, start, [])).max() > least
    return patch


INTEGRATORS = ("Euler", "implicitfast", "RK4")
# Curves share their code: one of them by every integrator.
SETTINGS = [
    (form, i) for form in FORMS for i in INTEGRATORS if i == "Euler" or FORMS[form].listed or form == "OverPosition"
]


@pytest.mark.parametrize(("form", "integrator"), SETTINGS)
def test_reproduces_the_engine(tmp_path, form, integrator):
    folder = tmp_path / "model"
    study = make_study(folder, model_xml(ARM_TIP, MOTORS + SENSORS, option=AIR.format(integrator)))
    on, effect = place_form(Simulator(study).model, form), FORMS[form]
    # What a late column shows first precedes the start: the engine follows the parabola, a caller holds.
    first = 3 if effect.uses("sample_time") else 0
    patch = check_reproduced(tmp_path, [(on, VALUES[form])], integrator, first)
    in_model = effect.changes and effect.changes != ("opt.timestep",)
    if in_model:
        assert patch.module is None
    else:
        assert effect.law_text in patch.module
        assert imports(patch.module) <= {"types", "weakref", "mujoco", "numpy"}


def test_its_text_is_in_shape(tmp_path):
    """As the rules of this repository have it, so that it may lie in a folder that is checked."""
    study = make_study(tmp_path / "study", model_xml(ARM_TIP, MOTORS + SENSORS, option=AIR.format("Euler")))
    model, folder = Simulator(study).model, tmp_path / "modules"
    texts = {form: module_text([(place_form(model, form), VALUES[form])]) for form in FORMS}
    texts["fields"] = module_text([], [FieldWrite("body_mass", (1,), [2.0])])
    folder.mkdir()
    for name, text in texts.items():
        (folder / f"{name}.py").write_text(text or "")
    rules = ["--no-cache", "--config", str(Path(__file__).parents[2] / "pyproject.toml")]
    done = subprocess.run([sys.executable, "-m", "ruff", "check", *rules, folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_a_finer_timestep_reproduces_the_engine(tmp_path, integrator):
    finer = CATALOGUE["numerical_integration"], {"timestep": 0.0005}
    patch = check_reproduced(tmp_path, [finer], integrator, least=1e-6, timestep=0.0005)
    assert patch.module is None


def imports(text):
    """The modules that a text imports."""
    nodes = list(ast.walk(ast.parse(text)))
    plain = {a.name for n in nodes if isinstance(n, ast.Import) for a in n.names}
    return plain | {n.module for n in nodes if isinstance(n, ast.ImportFrom)}


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_many_effects_at_once(tmp_path, integrator):
    effects = [
        ("viscous_damping", {"coefficient": 0.1}),
        ("cogging_torque", {"amplitude": 0.3, "cycles": 9.0, "phase": 0.4}),
        ("quadratic_drag", {"coefficient": 0.6}),
        ("actuator_gain", {"ratio": 1.4}),
        ("sensor_bias", {"offset": 0.1}),
        ("actuator_delay", {"delay": 0.0333}),
        ("constant_force", {"force": -0.2}),
        ("armature", {"inertia": 0.02}),
    ]
    late = [(LateColumn(), {"delay": 0.0253})]
    # At first a late column shows what precedes the start: the engine knows the parabola, a caller not yet.
    check_reproduced(tmp_path, [(CATALOGUE[n], v) for n, v in effects] + late, integrator, first=1)


def test_joins_a_recording_in_its_middle(tmp_path):
    time = np.arange(161) * 0.01
    study, simulator, recording, start = setting(tmp_path, "Euler", time)
    late = placed(CATALOGUE["actuator_delay"], simulator, recording.columns), {"delay": 0.0333}
    segments = from_pieces([recording], [(0, 60, 161)], recording.columns)
    fitted = rollout(simulator, segments, start, [late])
    states = np.random.default_rng(0).standard_normal((100, 2, 2))  # what was measured does not matter to the commands
    again = plain_loop(make_patch(study, {}, [late]), tmp_path, segments, start, replay=100, states=states)
    np.testing.assert_allclose(again, fitted, rtol=0, atol=1e-9)


def test_starting_again_forgets(tmp_path):
    study, simulator, recording, _ = setting(tmp_path, "Euler")
    late = placed(CATALOGUE["actuator_delay"], simulator, recording.columns), {"delay": 0.01}
    patch = make_patch(study, {}, [late])
    model, effects = mujoco.MjModel.from_xml_string(patch.model), load(patch.module, tmp_path)
    data, other = mujoco.MjData(model), mujoco.MjData(model)

    def give(data, value):
        data.ctrl[:] = value
        effects.control(model, data)
        mujoco.mj_step(model, data)
        return data.ctrl[late[0].element.ctrl]

    assert [give(data, v) for v in (1, 2, 2, 2, 2, 2, 2)] == pytest.approx([1, 1, 1, 1, 1, 1, 2], abs=1e-9)
    assert give(other, 5) == 5  # each data object has its own past
    mujoco.mj_resetData(model, data)
    assert give(data, 3) == 3  # time went back
    effects.reset(model, data)
    assert give(data, 4) == 4


def test_runs_without_the_package(tmp_path):
    study, simulator, recording, _ = setting(tmp_path, "Euler")
    drag = placed(CATALOGUE["quadratic_drag"], simulator, recording.columns), {"coefficient": 0.5}
    patch = make_patch(study, {}, [drag])
    (tmp_path / "patched.xml").write_text(patch.model)
    (tmp_path / "effects.py").write_text(patch.module)
    script = """
import sys
sys.modules["det2stoc_bayes"] = None
import mujoco, effects
model = mujoco.MjModel.from_xml_path("patched.xml")
data = mujoco.MjData(model)
effects.reset(model, data)
data.qvel[:] = 1
effects.control(model, data)
print(abs(data.xfrc_applied).max() > 0, effects.measure(model, data, ["qvel/elbow"]))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "True {'qvel/elbow': 1.0}", done.stderr


def test_a_free_body(tmp_path):
    study = make_study(tmp_path / "study", model_xml(FREE))
    simulator, columns = Simulator(study, num_threads=1), tuple(study.recordings[0].columns)
    drag = PlacedEffect(CATALOGUE["quadratic_drag"], simulator.elements("body", columns)[0], Typical())
    segments = cut([blank_recording(simulator.model, TIME, columns)])
    start = Start(np.array([[0, 0, 2, 0.6, 0.8, 0, 0]]), np.array([[1.0, 0, 3, 4, 5, 6]]), np.zeros((1, 0)))
    effects = [(drag, {"coefficient": 0.6})]
    fitted = rollout(simulator, segments, start, effects)
    moved = plain_loop(make_patch(study, {}, effects), tmp_path, segments, start)
    np.testing.assert_allclose(moved, fitted, rtol=0, atol=1e-9)
