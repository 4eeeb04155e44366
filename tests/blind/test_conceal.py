"""Concealed cases: reproducible, loadable, silent about what they hide, and as large as they say."""

import json
import re
import tomllib
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from det2stoc_bayes.blind.conceal import main, make_case
from det2stoc_bayes.blind.laws import LAWS
from det2stoc_bayes.blind.probe import draw_probe
from det2stoc_bayes.blind.reality import PREROLL, shifted
from det2stoc_bayes.blind.refit import refit
from det2stoc_bayes.blind.systems import SYSTEMS
from det2stoc_bayes.blind.variants import VARIANTS, choose, possible
from det2stoc_bayes.study import load_study

SHORT = {"num_recordings": 2, "num_samples": 40}


@pytest.fixture(scope="module")
def case():
    return make_case(5, system="arm", effect="coulomb_friction", **SHORT)


@pytest.fixture(scope="module")
def pair():
    return make_case(3, system="pendulum", effect="coulomb_friction", others=("cubic_stiffness",), **SHORT)


@pytest.mark.long
def test_three_effects_at_once_are_all_needed():
    found = make_case(5, system="cart_pole", count=3, num_recordings=2, num_samples=60).answer["effects"]
    assert len({(e["name"], e["element"]["name"]) for e in found}) == 3
    assert all(3 <= e["size_in_noise_sds"] <= 30 for e in found)


def test_a_seed_makes_the_same_case(case):
    again = make_case(5, system="arm", effect="coulomb_friction", **SHORT)
    assert again.study_files == case.study_files and again.answer == case.answer
    other = make_case(6, system="arm", control=True, **SHORT)
    assert other.study_files != make_case(7, system="arm", control=True, **SHORT).study_files


def test_files_and_columns(case, tmp_path):
    case.write(tmp_path)
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert found == sorted(case.study_files)
    assert sorted(found)[:3] == ["holdout/hold_01.csv", "holdout/hold_02.csv", "holdout/hold_03.csv"]
    header, *rows = case.study_files["recordings/rec_01.csv"].splitlines()
    assert header.startswith("time,qpos/shoulder,qpos/elbow,qvel/shoulder") and len(rows) == SHORT["num_samples"]
    study = tomllib.loads(case.study_files["study.toml"])
    assert set(study["psi"]) == set(case.answer["psi"])
    assert set(study["noise"]) == set(SYSTEMS["arm"].columns())
    mujoco.MjModel.from_xml_string(case.study_files["model.xml"])
    error = case.answer["truth_rmse"]  # of 120 samples: 1 sd is 6 %
    assert list(error) == SYSTEMS["arm"].columns()
    np.testing.assert_allclose(list(error.values()), SYSTEMS["arm"].noise(), rtol=0.3)


def words(case):
    """What a study's files say beside numbers."""
    found = re.findall(r"[A-Za-z_]+", "\n".join([*case.study_files, *case.study_files.values()]))
    return {word for word in found if word != "e"}  # of 1e-05


def test_nothing_tells_what_is_concealed(case, pair):
    for told, system in ((case, "arm"), (pair, "pendulum")):
        assert words(told) == words(make_case(1, system=system, control=True, **SHORT))
        assert not words(told) & {*LAWS, "conceal", "effect", "seed", "answer", "blind"}
        for value in told.answer["psi"].values():
            assert str(value)[:7] not in told.study_files["study.toml"] + told.study_files["model.xml"]


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_what_is_concealed_shows_in_what_is_fitted(seed):
    """A limit of commands is reached there; it may be reached in the experiments alone that its size was tuned on."""
    made = make_case(seed, system="lift_arm", effect="actuator_saturation", **SHORT)
    (effect,) = made.answer["effects"]
    column = f"ctrl/{effect['element']['name']}"
    tables = [text.splitlines() for name, text in made.study_files.items() if name.startswith("recordings/")]
    largest = max(abs(float(row.split(",")[rows[0].split(",").index(column)])) for rows in tables for row in rows[1:])
    assert largest > effect["parameters"]["limit"]


def test_sizes_are_what_psi_cannot_absorb(case, pair):
    for effect in (*case.answer["effects"], *pair.answer["effects"]):
        assert 3.0 <= effect["size_in_noise_sds"] <= 30.0
        assert effect["size_in_noise_sds"] <= 1.001 * effect["change_in_noise_sds"]
    assert case.answer["verdict"] == pair.answer["verdict"] == "mismatch"
    told = make_case(2, system="slider", effect="cubic_stiffness", size=12.0, **SHORT).answer["effects"][0]
    assert told["size_in_noise_sds"] == pytest.approx(12.0, rel=0.1)


def test_the_pair_is_in_the_answer(pair):
    assert [e["name"] for e in pair.answer["effects"]] == ["coulomb_friction", "cubic_stiffness"]


def read(text):
    header, *rows = text.splitlines()
    table = np.array([[float(cell) if cell else np.nan for cell in row.split(",")] for row in rows])
    return header.split(","), table


@pytest.mark.parametrize("name", ["cart_pole", "ball"])
def test_a_control_differs_from_its_believed_model_by_noise_alone(name):
    control, system = make_case(3, system=name, control=True, num_recordings=2, num_samples=200), SYSTEMS[name]
    assert control.answer["verdict"] == "no_mismatch" and control.answer["effects"] == []
    _, table = read(control.study_files["recordings/rec_01.csv"])
    times, count = table[:, 0], len(system.columns())
    columns, inputs = table[:, 1 : 1 + count], table[:, 1 + count :]
    probe = draw_probe(np.random.default_rng(0), system, control.answer["psi"], times).first()
    model = system.compile(control.answer["psi"])
    start = columns[0, : model.nq + model.nv].copy()
    if name == "ball":  # the quaternion's components have been given noise each
        start[3:7] /= np.linalg.norm(start[3:7])
    back = np.concatenate((-PREROLL * start[model.nq :], np.zeros(model.nv)))  # roughly; the refit does the rest
    start = shifted(model, start, back)
    fitted = refit(replace(probe, starts=[start], inputs=[inputs]), [columns]).left
    free = len(system.psi) + 2 * model.nv
    assert fitted == pytest.approx(np.sqrt(1.0 - free / columns.size), rel=0.06)


def test_coarse_integration():
    coarse = make_case(3, system="pendulum", effect="numerical_integration", **SHORT)
    model = mujoco.MjModel.from_xml_string(coarse.study_files["model.xml"])
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert coarse.answer["effects"][0]["parameters"] == {"timestep": 0.005, "integrator": "RK4"}


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="cart_pole"):
        make_case(1, system="rocket")
    with pytest.raises(ValueError, match="alone"):
        make_case(1, system="slider", effect="numerical_integration", count=2)
    with pytest.raises(ValueError, match="3 to 30"):
        make_case(1, size=100.0)
    with pytest.raises(ValueError, match="positions_only"):
        make_case(1, system="slider", variants=("blurred",))


@pytest.mark.parametrize("name", SYSTEMS)
def test_studies_load(name, tmp_path):
    made = make_case(1, system=name, control=True, **SHORT)
    study = load_study(made.write(tmp_path))
    assert [entry.name for entry in study.parameters] == list(made.answer["psi"])
    assert len(study.recordings) == 2 and len(study.holdout) == 3


@pytest.mark.parametrize("variant", VARIANTS)
def test_variants(variant, tmp_path):
    made = make_case(2, system="furuta", control=True, variants=(variant,), **SHORT)
    text = made.study_files["study.toml"]
    study = load_study(made.write(tmp_path))
    told, (names, table) = tomllib.loads(text), read(made.study_files["recordings/rec_01.csv"])
    assert made.answer["variants"] == [variant] and len(study.recordings) == 2
    match variant:
        case "positions_only":
            assert not any(n.startswith("qvel") for n in names) and "qpos/yaw" in names
        case "sensors":
            assert any(n.startswith("sensor/") for n in names) and "<sensor>" in made.study_files["model.xml"]
        case "unknown_noise":
            assert "noise" not in told
        case "varying_psi":
            (name,) = made.answer["varying"]["spread"]
            assert told["psi"][name]["varies"] == "trajectory"
            assert len({v[name] for v in made.answer["varying"]["recordings"].values()}) == 5
        case "known_values":
            assert {v["body/rotor/mass"] for v in told["known"].values()} != {0.4} and len(told["known"]) == 5
        case "irregular":
            assert np.ptp(np.diff(table[:, 0])) > 1e-3 and 0.005 < np.isnan(table[:, 1:-1]).mean() < 0.08
        case "outliers":
            count, noise = len(names) - 2, SYSTEMS["furuta"].noise()
            tables = [read(t)[1] for n, t in made.study_files.items() if n.endswith("csv")]
            jumps = [np.abs(np.diff(t[:, 1 : 1 + count], 4, axis=0)).max() / noise.min() for t in tables]
            assert max(jumps) > 30.0


def test_glitches_are_few_and_far():
    rng = np.random.default_rng(0)
    setting = choose(rng, SYSTEMS["cart_pole"], ("outliers",))
    clean = [np.zeros((50, 4)) for _ in range(3)]
    spoiled = np.concatenate(setting.spoil(rng, clean)) / SYSTEMS["cart_pole"].noise()
    assert 1 <= np.count_nonzero(spoiled) <= 4
    assert np.abs(spoiled[spoiled != 0.0]).min() >= 15.0 and not np.concatenate(clean).any()
    assert "known_values" not in possible(SYSTEMS["slider"])


def test_command_reveals_only_on_request(tmp_path, capsys):
    arguments = ["--seed", "4", "--system", "slider", "--effect", "constant_force", "--samples", "60"]
    assert main([*arguments, "--recordings", "1", "--out", str(tmp_path / "a")]) == 0
    out, err = capsys.readouterr()
    assert out == "" and "up to a minute" in err and "--reveal" in err
    assert main([*arguments, "--recordings", "1", "--out", str(tmp_path / "b"), "--reveal"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["effects"][0]["name"] == "constant_force" and "--reveal" not in err
    assert main(["--seed", "4", "--size", "99", "--out", str(tmp_path / "c")]) == 2
    assert "3 to 30" in capsys.readouterr().err and not (tmp_path / "c").exists()
    assert main([*arguments, "--recordings", "0", "--out", str(tmp_path / "c")]) == 2
    assert "found" not in capsys.readouterr().out and not (tmp_path / "c").exists()
    before = {p.name for p in (tmp_path / "a").iterdir()}
    assert main(["--seed", "5", "--system", "ball", "--out", str(tmp_path / "a")]) == 2
    assert "allowed: a new name" in capsys.readouterr().err
    assert {p.name for p in (tmp_path / "a").iterdir()} == before
