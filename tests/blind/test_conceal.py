"""Concealed cases: reproducible, loadable, silent about what they hide, and as large as they say."""

import importlib.util
import json
import tomllib

import mujoco
import numpy as np
import pytest

from det2stoc_bayes.blind.conceal import combinations, main, make_case
from det2stoc_bayes.blind.equivalents import accepted
from det2stoc_bayes.blind.laws import LAWS, Effect
from det2stoc_bayes.blind.reality import simulate_reality
from det2stoc_bayes.blind.systems import SYSTEMS

SHORT = {"num_recordings": 2, "num_samples": 80}


@pytest.fixture(scope="module")
def case():
    return make_case(5, system="arm", effect="coulomb_friction", **SHORT)


def test_a_seed_makes_the_same_case(case):
    again = make_case(5, system="arm", effect="coulomb_friction", **SHORT)
    assert again.study_files == case.study_files and again.answer == case.answer
    assert make_case(6, system="arm", effect="coulomb_friction", **SHORT).study_files != case.study_files


def test_files_and_columns(case, tmp_path):
    case.write(tmp_path)
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert found == sorted(case.study_files)
    assert sorted(found)[:3] == ["holdout/hold_01.csv", "holdout/hold_02.csv", "holdout/hold_03.csv"]
    header, *rows = case.study_files["recordings/rec_01.csv"].splitlines()
    assert header.startswith("time,qpos/shoulder,qpos/elbow,qvel/shoulder") and len(rows) == 80
    study = tomllib.loads(case.study_files["study.toml"])
    assert set(study["psi"]) == set(case.answer["psi"])
    assert set(study["noise"]) == set(SYSTEMS["arm"].columns())
    mujoco.MjModel.from_xml_string(case.study_files["model.xml"])


def test_nothing_tells_what_is_concealed(case):
    text = "\n".join([*case.study_files, *case.study_files.values()])
    for word in (*LAWS, "frictionloss", "armature", "conceal", "effect", "seed", "answer"):
        assert word not in text, word
    assert str(case.answer["psi"]["forearm_mass"])[:7] not in text


def test_size_is_as_told_and_psi_cannot_hide_it(case):
    assert 2.5 <= case.answer["size_in_noise_sds"] <= 33.0
    assert case.answer["unabsorbed_in_noise_sds"] >= 1.5
    assert case.answer["verdict"] == "mismatch"


def test_given_size_is_reached():
    told = make_case(2, system="slider", effect="cubic_stiffness", size=12.0, **SHORT).answer
    assert told["size_in_noise_sds"] == pytest.approx(12.0, rel=0.06)


def test_control_and_coarse_integration():
    control = make_case(3, system="pendulum", control=True, **SHORT)
    assert control.answer["verdict"] == "no_mismatch" and control.answer["effects"] == []
    coarse = make_case(3, system="pendulum", effect="numerical_integration", **SHORT)
    model = mujoco.MjModel.from_xml_string(coarse.study_files["model.xml"])
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert coarse.answer["effects"][0]["parameters"] == {"timestep": 0.005, "integrator": "RK4"}


def test_unknown_and_absorbed_are_refused():
    with pytest.raises(ValueError, match="cart_pole"):
        make_case(1, system="rocket")
    with pytest.raises(ValueError, match="psi absorbs"):
        make_case(1, system="slider", effect="armature")
    for system in SYSTEMS.values():
        assert not set(combinations(system)) & set(system.absorbed)


@pytest.mark.parametrize(
    ("name", "effect"),
    [
        ("pendulum", Effect("quadratic_drag", "body", "rod", {"coefficient": 0.2})),
        ("cart_pole", Effect("quadratic_damping", "joint", "track", {"coefficient": 0.2})),
        ("slider", Effect("sensor_bias", "sensor", "qpos/rail", {"offset": 0.02})),
    ],
)
def test_equivalents_make_the_same_recordings(name, effect):
    system, rng, times = SYSTEMS[name], np.random.default_rng(4), 0.01 * np.arange(200)
    psi, start, inputs = system.draw_psi(rng), system.draw_start(rng), system.draw_inputs(rng, times)
    first = simulate_reality(system, psi, effect, start, times, inputs)
    other = next(entry for entry in accepted(system, psi, effect) if entry["name"] in LAWS)
    same = Effect(other["name"], other["element"]["kind"], other["element"]["name"], other["parameters"])
    moved = start + np.array([effect.parameters.get("offset", 0.0), *np.zeros(start.size - 1)])
    second = simulate_reality(system, psi, same, moved, times, inputs)
    np.testing.assert_allclose(second, first, atol=1e-6)


def test_an_angle_bias_is_a_tilt_the_other_way():
    system, rng, times = SYSTEMS["pendulum"], np.random.default_rng(4), 0.01 * np.arange(200)
    psi, start, inputs = system.draw_psi(rng), system.draw_start(rng), system.draw_inputs(rng, times)
    bias = Effect("sensor_bias", "sensor", "qpos/pivot", {"offset": 0.05})
    read = simulate_reality(system, psi, bias, start, times, inputs)
    lean = accepted(system, psi, bias)[0]["parameters"]["toward_x"]
    model = system.compile(psi)
    model.opt.gravity[:] = 9.81 * np.array([np.sin(lean), 0.0, -np.cos(lean)])
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start[0] + 0.05, start[1]
    for k in range(200):
        assert data.qpos[0] == pytest.approx(read[k, 0], abs=1e-6)
        data.ctrl[:] = inputs[k]
        mujoco.mj_step(model, data, nstep=2)


@pytest.mark.skipif(importlib.util.find_spec("det2stoc_bayes.study") is None, reason="needs the study reader")
@pytest.mark.parametrize("name", SYSTEMS)
def test_studies_load(name, tmp_path):
    from det2stoc_bayes.study import load_study

    made = make_case(1, system=name, control=True, **SHORT)
    study = load_study(made.write(tmp_path))
    assert [entry.name for entry in study.parameters] == list(made.answer["psi"])
    assert len(study.recordings) == 2 and len(study.holdout) == 3


def test_command_reveals_only_on_request(tmp_path, capsys):
    arguments = ["--seed", "4", "--system", "slider", "--effect", "constant_force", "--samples", "80"]
    main([*arguments, "--recordings", "1", "--out", str(tmp_path / "a")])
    assert capsys.readouterr().out == ""
    main([*arguments, "--recordings", "1", "--out", str(tmp_path / "b"), "--reveal"])
    assert json.loads(capsys.readouterr().out)["effects"][0]["name"] == "constant_force"
