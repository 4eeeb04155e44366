"""Studies: what is read, what is refused, and that nothing is half-read."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from det2stoc_bayes.engines.model_names import (
    KINDS,
    believed_value,
    compile_model,
    field_of,
    model_names,
    rows_of,
)
from det2stoc_bayes.errors import Det2StocError, ModelError, StudyError
from det2stoc_bayes.recording import StudyWarning
from det2stoc_bayes.study import Target, load_study

REAL = Path(__file__).parents[2] / "shared/studies"
MODEL = """<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="box">
      <freejoint name="box"/>
      <geom name="box" size=".1"/>
      <body name="tip"><joint name="ball" type="ball"/><geom size=".1"/></body>
    </body>
    <body name="arm">
      <joint name="robot/elbow" range="-90 90"/>
      <geom name="arm" size=".1"/>
      <site name="imu"/>
    </body>
  </worldbody>
  <contact><pair name="floor_box" geom1="floor" geom2="box"/></contact>
  <tendon><fixed name="cable"><joint joint="robot/elbow" coef="1"/></fixed></tendon>
  <actuator><motor name="motor" joint="robot/elbow"/><motor joint="robot/elbow"/></actuator>
  <sensor><gyro name="gyro" site="imu"/><jointpos name="encoder" joint="robot/elbow"/><clock/></sensor>
</mujoco>
"""
STUDY = """
[psi.friction]
target = "pair/floor_box/friction"
index = [0, 1]
prior = { TruncatedNormal = { loc = 0.25, scale = 0.1, low = 0.1, high = 4.0 } }
varies = "trajectory"

[psi.damping]
target = "joint/robot/elbow/damping"
prior = { HalfNormal = {} }

[noise]
"qpos/*" = 1e-3
"qpos/box/?" = 2e-3
"qpos/box/y" = 3
"sensor/*" = 0.1
"*" = 9

[known.b]
"body/tip/mass" = 0.045
"geom/*/size" = [0.1, 0.0, 0.0]
"""
CSV = "time,qpos/robot/elbow,qpos/box/x,qpos/box/y\n0,0,1,2\n1,1,2,1\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "my_study"
    for name, text in {
        "model.xml": MODEL,
        "study.toml": STUDY,
        "recordings/a.csv": CSV,
        "recordings/b.csv": CSV.replace("qpos/box/y", "sensor/gyro/2"),
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_all_parts_are_there(folder: Path):
    study = load_study(folder)
    assert study.name == "my_study" and study.model_path == folder / "model.xml"
    friction, damping = study.parameters
    assert friction.name == "friction" and friction.index == (0, 1) and friction.varies == "trajectory"
    assert str(friction.target) == "pair/floor_box/friction"
    assert damping.target == Target("joint", "robot/elbow", "damping")
    assert damping.index is None and damping.varies == "never" and damping.prior.family == "HalfNormal"
    assert [r.name for r in study.recordings] == ["a", "b"] and study.holdout == ()
    assert list(study.known) == ["b"]
    known = study.known["b"]
    assert known[Target("body", "tip", "mass")].shape == ()
    np.testing.assert_array_equal(known[Target("geom", "*", "size")], [0.1, 0, 0])
    again = pickle.loads(pickle.dumps(study))
    assert again.parameters == study.parameters and again.names == study.names


def test_noise_of_the_name_then_of_the_longest_pattern(folder: Path):
    expected = {"qpos/robot/elbow": 1e-3, "qpos/box/x": 2e-3, "qpos/box/y": 3.0, "sensor/gyro/2": 0.1}
    assert load_study(folder).noise == expected


def test_psi_toml_is_read_with_defaults(folder: Path):
    (folder / "study.toml").rename(folder / "psi.toml")
    (folder / "holdout").mkdir()
    (folder / "holdout/c.csv").write_text(CSV)
    study = load_study(folder)
    assert len(study.parameters) == 2 and [r.name for r in study.holdout] == ["c"]
    (folder / "study.toml").write_text("")
    with pytest.warns(StudyWarning, match="psi.toml is not read"):
        assert load_study(folder).parameters == ()


def test_names_of_the_model(folder: Path):
    names = load_study(folder).names
    assert names.columns[:4] == ("qpos/box/x", "qpos/box/y", "qpos/box/z", "qpos/box/qw")
    assert {"qvel/box/vx", "qvel/box/wz", "qpos/ball/qz", "qvel/ball/wx", "sensor/gyro/0"} < set(names.columns)
    assert names.columns[-3:] == ("sensor/gyro/1", "sensor/gyro/2", "sensor/encoder")
    assert not {"qpos/ball/x", "qvel/ball/vx", "sensor/gyro", "sensor/"} & set(names.columns)
    assert names.actuators == ("motor", "") and names.elements["actuator"] == ("motor",)
    assert names.quaternions == tuple(tuple(f"qpos/{j}/{p}" for p in ("qw", "qx", "qy", "qz")) for j in ("box", "ball"))
    assert names.hinges == {"qpos/robot/elbow": pytest.approx((-np.pi / 2, np.pi / 2))}
    assert names.elements["body"] == ("box", "tip", "arm")
    assert set(names.fields) == set(names.elements) == set(KINDS)


def test_rows_and_values_of_every_field(folder: Path):
    model = compile_model(folder / "model.xml")
    names = model_names(model)
    for kind in KINDS:
        for field, shape in names.fields[kind].items():
            for name in ("*", *names.elements[kind]):
                value = believed_value(model, kind, name, field)
                assert value.shape == (len(rows_of(model, kind, name, field)), *shape)
    assert rows_of(model, "joint", "ball", "damping").tolist() == [6, 7, 8]
    assert rows_of(model, "joint", "ball", "springref").tolist() == []
    assert rows_of(model, "geom", "*", "friction").tolist() == [0, 1, 2, 3]
    assert rows_of(model, "body", "*", "mass").tolist() == [1, 2, 3]
    assert field_of("joint", "damping") == "dof_damping" and field_of("opt", "wind") == "opt.wind"
    for kind, field in [("joint", "dampling"), ("jiont", "damping")]:
        with pytest.raises(ModelError, match="did you mean"):
            field_of(kind, field)


def psi(**changes: str) -> str:
    keys = {"target": '"pair/floor_box/friction"', "index": "[0]", "prior": "{ Normal = {} }"} | changes
    return "[psi.mu]\n" + "\n".join(f"{key} = {value}" for key, value in keys.items() if value)


MISTAKES = {  # study.toml, what the message names, what it allows
    "toml": ("[psi", "study.toml: ", "TOML"),
    "duplicate key": ("[noise]\n'*' = 1\n'*' = 2", "study.toml: ", "TOML"),
    "top-level key": ("[pis.mu]", "pis: unknown key", "did you mean 'psi'? allowed: model, recordings"),
    "psi key": (
        psi(priors="1"),
        "psi.mu.priors: unknown key",
        "did you mean 'prior'? allowed: target, prior",
    ),
    "no target": (psi(target=""), "psi.mu.target: missing", "target, prior, index, varies"),
    "psi as number": ("psi = 3", "psi: found 3", "allowed: a table"),
    "target as number": (psi(target="3"), "psi.mu.target: found 3", "allowed: a text in quotes"),
    "short target": (psi(target='"friction"'), "psi.mu.target: found 'friction'", "kind/name/field"),
    "opt with name": (psi(target='"opt/x/gravity"'), "found 'opt/x/gravity'", "opt/field"),
    "kind": (psi(target='"pear/floor_box/friction"'), "'pear/floor_box/friction'", "kind body, joint, geom"),
    "name": (psi(target='"pair/floor_bocks/friction"'), "named 'floor_bocks'", "did you mean 'floor_box'?"),
    "pattern": (psi(target='"pair/floor_*/friction"'), "named 'floor_*'", "allowed: floor_box, *"),
    "world": (psi(target='"body/world/mass"', index=""), "no body named 'world'", "box, tip, arm, *"),
    "field": (psi(target='"pair/floor_box/frction"'), "no field 'frction'", "did you mean 'friction'?"),
    "integer field": (psi(target='"geom/box/contype"'), "no field 'contype'", "friction, size"),
    "no such element": (psi(target='"joint/ball/springref"', index=""), "psi.mu.target", "has a springref"),
    "index of a number": (psi(target='"joint/ball/damping"'), "index: found [0]", "no index"),
    "no index": (psi(index=""), "psi.mu.index: missing", "a list of 0 to 4"),
    "index too large": (psi(index="[5]"), "index: found [5]", "from 0 to 4"),
    "negative index": (psi(index="[-1]"), "index: found [-1]", "from 0 to 4"),
    "index twice": (psi(index="[1, 1]"), "index: found [1, 1]", "different components"),
    "index as text": (psi(index='["0"]'), "psi.mu.index.0: found '0'", "valid integer"),
    "varies": (psi(varies='"always"'), "psi.mu.varies: found 'always'", "'never' or 'trajectory'"),
    "varies without sd": (
        psi(varies='"trajectory"', prior="{ Cauchy = {} }"),
        "psi.mu.varies: found a prior of Cauchy",
        "'never'",
    ),
    "prior argument": (
        psi(prior="{ TruncatedNormal = { scael = 1.0 } }"),
        "study.toml: psi.mu.prior.TruncatedNormal.scael: unknown argument",
        "allowed: loc, scale, low, high",
    ),
    "prior family": (psi(prior="{ Gaussian = {} }"), "unknown prior 'Gaussian'", "Normal, TruncatedNormal"),
    "psi name": ('[psi."a b"]' + psi()[8:], "found the name 'a b'", "letters"),
    "reserved name": ("[psi.draw]" + psi()[8:], "found the name 'draw'", "not chain, draw"),
    "same number": (
        psi() + "\n[psi.all]\ntarget = 'pair/*/friction'\nindex = [2, 0]\nprior = { Normal = {} }",
        "pair/*/friction is set by psi.mu already",
        "one psi",
    ),
    "derived name": (
        psi(varies='"trajectory"') + "\n[psi.mu_sigma]\ntarget = 'body/tip/mass'\nprior = { Normal = {} }",
        "psi.mu_sigma: psi.mu varies and uses that name",
        "another",
    ),
    "noise without column": (
        "[noise]\n'qpos/elbow' = 1",
        "'qpos/elbow': no column",
        "did you mean 'qpos/robot/elbow'?",
    ),
    "noise of control": ("[noise]\n'ctrl/motor' = 1", "noise.'ctrl/motor'", "qpos/box/x"),
    "noise 0": ("[noise]\n'*' = 0", "noise.*: found 0", "1e-30 to 1e+12"),
    "noise below 0": ("[noise]\n'*' = -1e-3", "noise.*: found -0.001", "1e-30 to 1e+12"),
    "noise nan": ("[noise]\n'*' = nan", "noise.*: found nan", "1e-30 to 1e+12"),
    "noise so small": ("[noise]\n'*' = 1e-300", "noise.*: found 1e-300", "1e-30 to 1e+12"),
    "noise so large": ("[noise]\n'*' = 1e300", "noise.*: found 1e+300", "1e-30 to 1e+12"),
    "noise as text": ("[noise]\n'*' = '1'", "noise.*: found '1'", "1e-30 to 1e+12"),
    "noise unquoted": ("[noise]\nqpos/box/x = 1", "study.toml: ", "names with a slash are quoted"),
    "known recording": (
        "[known.bb]\n'body/tip/mass' = 1",
        "known.bb: no such recording",
        "did you mean 'b'?",
    ),
    "known name": ("[known.b]\n'body/tipp/mass' = 1", "known.b.'body/tipp/mass'", "did you mean 'tip'?"),
    "known number": ("[known.b]\n'geom/box/size' = 1", "found 1.0", "a list of 3 numbers"),
    "known length": ("[known.b]\n'geom/box/size' = [1, 2]", "found [1.0, 2.0]", "a list of 3 numbers"),
    "known vector": ("[known.b]\n'body/tip/mass' = [1, 2]", "found [1.0, 2.0]", "one number"),
    "known text": ("[known.b]\n'body/tip/mass' = '1'", "known.b.body/tip/mass: found '1'", "a finite number"),
    "known massless": ("[known.b]\n'body/tip/mass' = 0.0", "found 0", "more than 0, since a body has some mass"),
    "known direction": ("[known.b]\n'body/tip/quat' = [2, 0, 0, 0]", "of length 2", "allowed: length 1"),
    "known infinite": ("[known.b]\n'body/tip/mass' = inf", "found inf", "a finite number"),
    "no recordings": ("recordings = 'rec/*.csv'", "no file matches 'rec/*.csv'", "one or more"),
    "parent": ("recordings = '../other/*.csv'", "found '../other/*.csv'", "within the study's folder"),
    "absolute": ("holdout = '/tmp/*.csv'", "holdout: found '/tmp/*.csv'", "within the study's folder"),
    "model parent": ("model = '../model.xml'", "model: '../model.xml' lies outside", "files within it"),
    "no model": ("model = 'modle.xml'", "modle.xml: no such file", "did you mean 'model.xml'?"),
    "model type": ("model = 'study.toml'", "study.toml: the model is an MJCF file", ".xml"),
    "fitted and held out": ("holdout = 'recordings/a*'", "recordings/a.csv is among", "never fitted"),
}


@pytest.mark.parametrize(("text", "found", "allowed"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_named(folder: Path, text: str, found: str, allowed: str):
    (folder / "study.toml").write_text(text)
    with pytest.raises(Det2StocError) as caught:
        load_study(folder)
    message = str(caught.value)
    assert "\n" not in message and ("study.toml" in message or "modle.xml" in message)
    assert found in message and allowed in message


def refusal(folder: Path) -> str:
    with pytest.raises(Det2StocError) as caught:
        load_study(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_folders_without_a_study(folder: Path):
    assert "allowed: a folder with study.toml" in refusal(folder / "absent")
    assert "a file; allowed: a folder with study.toml" in refusal(folder / "study.toml")
    assert "found neither study.toml nor psi.toml but a.csv, b.csv" in refusal(folder / "recordings")


def test_a_byte_order_mark_is_no_mistake(folder: Path):
    text = (folder / "study.toml").read_text("utf-8")
    (folder / "study.toml").write_text(text, encoding="utf-8-sig")
    assert load_study(folder).recordings


def test_stems_name_one_recording(folder: Path):
    (folder / "holdout").mkdir()
    (folder / "holdout/b.csv").write_text(CSV)
    assert "known.b: found it in recordings and in holdout" in refusal(folder)
    (folder / "study.toml").write_text("")
    with pytest.warns(StudyWarning, match="holdout_b: the same samples as"):
        study = load_study(folder)
    assert [r.name for r in study.holdout] == ["holdout_b"]  # results go by names
    for held_out in (False, True):  # a name that a fitted one has takes another
        (folder / ("holdout" if held_out else "recordings") / "holdout_b.csv").write_text(CSV.replace("1,1,2", "1,1,3"))
    with pytest.warns(StudyWarning, match="the same samples"):
        study = load_study(folder)
    assert sorted(r.name for r in study.holdout) == ["holdout_holdout_b", "holdout_holdout_holdout_b"]
    (folder / "recordings" / "holdout_b.csv").unlink()
    (folder / "holdout" / "holdout_b.csv").unlink()
    (folder / "study.toml").write_text("recordings = '**/*.csv'\nholdout = ''")
    assert "holdout: found ''" in refusal(folder)
    (folder / "study.toml").write_text("recordings = '**/b.csv'\nholdout = 'recordings/a.csv'")
    assert "found 'b' twice: holdout/b.csv, recordings/b.csv" in refusal(folder)


def test_links_do_not_lead_outside(folder: Path):
    outside = folder.parent / "outside.csv"
    outside.write_text(CSV)
    (folder / "recordings/c.csv").symlink_to(outside)
    assert "recordings/c.csv' lies outside of the study's folder" in refusal(folder)
    (folder / "recordings/c.csv").unlink()
    (folder / "recordings/c.csv").symlink_to(folder / "recordings/a.csv")
    assert len(load_study(folder).recordings) == 3


@pytest.mark.parametrize(
    "part",
    [
        "<include file='../part.xml'/>",
        "<asset><mesh name='m' file='part.stl'/></asset><compiler meshdir='..'/>",
    ],
)
def test_model_files_do_not_lead_outside(folder: Path, part: str):
    (folder.parent / "part.xml").write_text("<mujoco/>")
    (folder / "model.xml").write_text(MODEL.replace("<worldbody>", part + "<worldbody>"))
    assert "outside of the study's folder" in refusal(folder)


def test_included_files_within_the_folder_are_read(folder: Path):
    (folder / "parts").mkdir()
    (folder / "parts/part.xml").write_text("<mujoco><option timestep='0.003'/></mujoco>")
    (folder / "model.xml").write_text(MODEL.replace("<worldbody>", "<include file='parts/part.xml'/><worldbody>"))
    assert load_study(folder).recordings
    (folder / "parts/part.xml").write_text("<mujoco><option gravity='0 0 nan'/></mujoco>")
    assert refusal(folder) == "part.xml: option gravity: found '0 0 nan'; allowed: finite numbers"


@pytest.mark.parametrize("text", ["", "<mujoco>", "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>", "x"])
def test_models_that_do_not_compile(folder: Path, text: str):
    (folder / "model.xml").write_text(text)
    message = refusal(folder)
    assert message.startswith("model.xml: does not compile: ")


def test_a_bad_recording_fails_the_study(folder: Path):
    (folder / "recordings/b.csv").write_text(CSV + "2,x,1,1\n")
    assert refusal(folder).startswith("recordings/b.csv: line 4: column qpos/robot/elbow: found 'x'")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            psi(prior="{ Uniform = { low = 2.0, high = 3.0 } }"),
            "psi.mu: the model's pair/floor_box/friction = 1 lies",
        ),
        ("[noise]\n'qvel/*' = 1", r"noise.'qvel/\*': no recording has such a column"),
        (
            "holdout = 'held_out/*.csv'",
            r"holdout: no file matches 'held_out/\*.csv'; a diagnosis sets recordings aside itself",
        ),
        (
            psi() + "\n[known.b]\n'pair/floor_box/friction' = [1, 1, 0.005, 0.0001, 0.0001]",
            "known.b.'pair/floor_box/friction' stands in the place of psi.mu in that recording",
        ),
    ],
)
def test_suspicions_are_told(folder: Path, text: str, told: str):
    (folder / "study.toml").write_text(text)
    with pytest.warns(StudyWarning, match=told):
        load_study(folder)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real studies lie beside the repository, and are not here")
@pytest.mark.parametrize("name", ["ball_drops", "cube_contactnets", "pendulum_multiarm", "servo_xl330"])
@pytest.mark.filterwarnings("default::det2stoc_bayes.recording.StudyWarning")
def test_real_studies_load(name: str):
    study = load_study(REAL / name)
    assert study.parameters and study.recordings and study.holdout
    measured = {column for recording in study.recordings for column in recording.columns}
    assert set(study.noise) == measured
    if name == "ball_drops":
        assert len(study.known) == 20
    if name == "servo_xl330":
        assert all(np.ptp(recording.ctrl) > 0 for recording in study.recordings)


def test_import_leaves_jax_and_mujoco_alone():
    code = "import sys, det2stoc_bayes.study; sys.exit(bool({'jax', 'mujoco', 'numpyro'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_timestep_is_no_psi(folder: Path):
    (folder / "study.toml").write_text('[psi.step]\ntarget = "opt/timestep"\nprior = { HalfNormal = {} }\n')
    with pytest.raises(StudyError, match=r"psi.step.target: 'opt/timestep': the samples' times .*allowed: gravity"):
        load_study(folder)


def test_a_clock_that_is_not_in_seconds(folder: Path):
    """Longer than any simulation: an error; another rate than the others': a warning."""
    good = (folder / "recordings" / "a.csv").read_text()
    header, *lines = good.strip().split("\n")
    at = header.split(",").index("time")

    def rewritten(change):
        cells = [line.split(",") for line in lines]
        for i, row in enumerate(cells):
            row[at] = repr(change(i, float(row[at])))
        (folder / "recordings" / "a.csv").write_text("\n".join([header, *(",".join(row) for row in cells)]) + "\n")

    rewritten(lambda i, t: 1e9 if i == len(lines) - 1 else t)
    assert "recordings/a.csv: column time: found 1e+09 s" in refusal(folder)
    rewritten(lambda i, t: 1000 * t)
    with pytest.warns(StudyWarning, match=r"a.csv: column time: a sample every .* \(is it in seconds\?\)"):
        load_study(folder)


@pytest.mark.filterwarnings("ignore::det2stoc_bayes.recording.StudyWarning")
def test_steps_longer_than_the_recording(folder: Path):
    (folder / "model.xml").write_text(MODEL.replace("<worldbody>", '<option timestep="2.5"/><worldbody>', 1))
    assert "recordings/a.csv: column time: found 1 s, less than one of the model's steps (2.5 s)" in refusal(folder)
    rows = "".join(f"{t},0,1,2\n" for t in range(5))
    for path in (folder / "recordings").iterdir():
        path.write_text(CSV.split("\n")[0] + "\n" + rows)
    with pytest.warns(StudyWarning, match=r"a sample every 1 s, but the model's timestep is 2.5 s"):
        load_study(folder)


def test_a_number_beyond_all_measure(folder: Path):
    path = folder / "recordings" / "a.csv"
    header, first, *rest = path.read_text().split("\n")
    cells = first.split(",")
    cells[-1] = "1e300"
    path.write_text("\n".join([header, ",".join(cells), *rest]))
    assert "found 1e+300; allowed: at most 1e+12 in size" in refusal(folder)
