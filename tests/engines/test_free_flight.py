"""How free bodies fall between their touches, against what made them fall."""

import io
import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import sliding
from conftest import make_study, state_columns
from rich.console import Console

from det2stoc_bayes import tables
from det2stoc_bayes.engines.free_flight import Fall, falls
from det2stoc_bayes.identifiability import check
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator

NOISE = 3e-4  # m
XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <body name="box" pos="0 0 .3"><freejoint name="toss"/>
    <geom name="shell" type="box" size=".05 .04 .03" mass=".3"/><geom size=".02" pos=".06 0 0" mass=".1"/></body>
  </worldbody></mujoco>"""
TOSS = '[psi.friction]\ntarget = "geom/*/friction"\nindex = [0]\nprior = { Normal = { loc = 1.0, scale = 0.2 } }\n'
TOSS += '[noise]\n"qpos/*/q*" = 1e-3\n"qpos/*" = 3e-4\n"qvel/*" = 1e-2\n'


def tosses(gravity, seed, count=6):
    """Recordings of a box that spins, falls, bounces and lies, the centre of mass not where its frame is."""
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.gravity[:] = gravity
    random, names, out = np.random.default_rng(seed), state_columns(model), {}
    for k in range(count):
        data = mujoco.MjData(model)
        data.qvel[:6] = *random.normal(0, 0.4, 2), 0.5, *random.normal(0, 5.0, 3)
        time, rows = np.arange(60) * 0.01, []
        for _ in time:
            rows.append(np.concatenate([data.qpos, data.qvel]))
            mujoco.mj_step(model, data, 5)
        values = np.array(rows)
        values[:, :3] += NOISE * random.standard_normal((len(time), 3))
        out[f"toss_{k}"] = (time, dict(zip(names, values.T, strict=True)))
    return out


def problem_of(folder, xml, toml, recordings):
    return make_problem(Simulator(make_study(folder, xml, toml, recordings)))


def test_a_fall_is_what_gravity_made_it(tmp_path):
    """By a parabola through n samples of noise s over T its error is near s sqrt(720 / n) / T^2: 0.01 m/s2 a flight."""
    gravity = (0.3, 0.0, -9.4)
    (fall,) = falls(problem_of(tmp_path / "s", XML, TOSS, tosses(gravity, 1)))
    assert fall.body == "box" and fall.flights >= 6 and fall.believed == (0.0, 0.0, -9.81)
    apart = np.abs(np.subtract(fall.acceleration, gravity)) / fall.error
    assert max(fall.error) < 0.02 and apart.max() < 4.0  # measured: 0.012 m/s2, 2.2
    assert fall.contradicts and "box touches nothing" in fall.text and "-9.81" in fall.text


def test_what_falls_as_the_model_has_it_is_silent(tmp_path):
    """A centre of mass beside the frame and a spin are no acceleration; nor is what lies on the floor a flight."""
    for seed in range(8):
        recordings = tosses((0.0, 0.0, -9.81), seed)
        (fall,) = falls(problem_of(tmp_path / f"s{seed}", XML, TOSS, recordings))
        assert not fall.contradicts, fall


@pytest.mark.parametrize(("old", "new"), [
    ("<option ", '<option density="1.2" '),
    ("</mujoco>", '<actuator><motor joint="toss" gear="0 0 1 0 0 0"/></actuator></mujoco>'),
    ('<freejoint name="toss"/>', '<joint name="toss" type="free" damping="0.1"/>'),
    ('<body name="box"', '<body name="box" gravcomp="0.5"'),
])  # fmt: skip
def test_where_more_than_gravity_acts_nothing_is_said(tmp_path, old, new):
    assert old in XML
    recordings = tosses((0.0, 0.0, -5.0), 1)
    assert falls(problem_of(tmp_path / "s", XML.replace(old, new), TOSS, recordings)) == ()


@pytest.mark.parametrize("table", [
    '[psi.gravity]\ntarget = "opt/gravity"\nindex = [2]\nprior = { Normal = { loc = -9.8, scale = 1.0 } }\n',
    '[known.toss_0]\n"opt/gravity" = [0.0, 0.0, -5.0]\n',
])  # fmt: skip
def test_what_the_study_says_of_gravity_is_not_held_against_the_model(tmp_path, table):
    assert falls(problem_of(tmp_path / "s", XML, TOSS + table, tosses((0.0, 0.0, -5.0), 1))) == ()


def test_what_slides_or_is_not_wholly_recorded_does_not_fly(tmp_path):
    assert falls(problem_of(tmp_path / "slides", sliding.XML.format(0.02), sliding.PSI, sliding.slides(count=6))) == ()
    part = {
        name: (time, {c: v for c, v in columns.items() if not c.endswith(("qw", "qx", "qy", "qz"))})
        for name, (time, columns) in tosses((0.0, 0.0, -5.0), 1).items()
    }
    assert falls(problem_of(tmp_path / "part", XML, TOSS, part)) == ()


def test_few_flights_must_contradict_by_more():
    """Of n flights the error is itself uncertain: by Student's t of n - 1 degrees of freedom."""
    many = Fall("box", 50, (0.0, 0.0, -9.5), (0.02, 0.02, 0.05), (0.0, 0.0, -9.81))
    assert many.contradicts and not replace(many, flights=5).contradicts
    assert not replace(many, acceleration=(0.0, 0.0, -9.75), error=(1e-4,) * 3).contradicts  # sure, and small


def test_check_says_it(tmp_path):
    checked = check(make_study(tmp_path / "study", XML, TOSS, tosses((0.0, 0.0, -8.8), 2)))
    (told,) = json.loads(json.dumps(tables.check_json(checked)))["free_flight"]
    assert told["contradicts"] and told["acceleration"][2] == pytest.approx(-8.8, abs=4 * told["error"][2])
    screen = Console(width=400, record=True, file=io.StringIO())
    screen.print(tables.check_tables(checked))
    assert checked.falls[0].text in screen.export_text()
