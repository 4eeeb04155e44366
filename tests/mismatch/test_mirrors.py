"""Where a mirror tells the recordings as well, both tops are told."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import PENDULUM, noise_table, place, pose, recordings

from det2stoc_bayes.density import Density
from det2stoc_bayes.engines.magnitudes import Magnitudes
from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch import finding
from det2stoc_bayes.mismatch.belief import believe
from det2stoc_bayes.mismatch.mirrors import mirrored
from det2stoc_bayes.mismatch.statements import parameters, spanning
from det2stoc_bayes.optimize import fit_many

CENTRE = np.array([0.3, 0.25, 0.75])


def believed(tmp_path, name, element, values, push):
    starts = [([0.4], [0.0]), ([-0.8], [1.0]), ([1.2], [-0.5])]
    made = recordings(model_xml(PENDULUM), starts, 5 * np.arange(60), (1e-3, 1e-2), push=push)
    problem = pose(make_study(tmp_path / name, model_xml(PENDULUM), noise_table(1e-3, 1e-2), made))
    placed = place(problem, name, element or problem.simulator.elements("body", ())[0].name)
    placed = replace(placed, typical=Magnitudes(problem).of(placed.element))
    problem = problem.with_effects((placed,))
    z = placed.effect.to_normal(values, placed.typical)
    (fit,) = fit_many([(problem, start_point(problem, np.concatenate([np.zeros(problem.num_psi), z])))])
    return believe(fit, 1.0, 0), placed


def pulled(model, data):
    away = data.xipos[1] - CENTRE
    data.xfrc_applied[1, :3] = -0.05 * away / np.linalg.norm(away) ** 3


def test_a_point_beside_a_plane_of_motion_has_a_twin_behind_it(tmp_path):
    belief, placed = believed(tmp_path, "attraction", "", {"strength": 0.05, "centre": CENTRE}, pulled)
    (twin,) = mirrored(belief, placed)
    here, there = (parameters(belief.fit, placed, z) for z in (belief.z, twin))
    (x, y, z), (x_there, y_there, z_there) = here["centre"].mean, there["centre"].mean
    assert (x_there, y_there, z_there) == pytest.approx((x, -y, z), abs=1e-9)
    assert y == pytest.approx(CENTRE[1], abs=4 * here["centre"].sd[1])
    both = spanning(here, [{"centre": there["centre"]}])["centre"]
    assert isinstance(both, finding.Quantity)
    assert both.interval[1] == pytest.approx((there["centre"].interval[1][0], here["centre"].interval[1][1]))
    assert both.interval[0] == here["centre"].interval[0] and both.mean == here["centre"].mean


def test_an_offset_in_the_plane_has_none(tmp_path):
    def pushed(model, data):
        data.xfrc_applied[1, 3:] = np.cross(data.xmat[1].reshape(3, 3) @ [0.02, 0.0, 0.01], 0.8 * model.opt.gravity)

    belief, placed = believed(tmp_path, "com_offset", "", {"offset": np.array([0.02, 0.0, 0.01])}, pushed)
    assert (np.abs(belief.z.mean(0))[-3:][[0, 2]] > 2 * belief.z.std(0)[-3:][[0, 2]]).all()
    assert mirrored(belief, placed) == []


def test_gravity_leans_to_either_side_of_the_plane(tmp_path):
    tilt = 0.3

    def leaned(model, data):
        data.xfrc_applied[1, 2] = model.body_mass[1] * 9.81 * (1 - np.cos(tilt))

    values = {"toward_x": 0.0, "toward_y": tilt}
    belief, placed = believed(tmp_path, "gravity_tilt", "world", values, leaned)
    (twin,) = mirrored(belief, placed)
    here, there = (parameters(belief.fit, placed, z)["toward_y"] for z in (belief.z, twin))
    assert isinstance(here, finding.Quantity) and isinstance(there, finding.Quantity)
    assert there.mean == pytest.approx(-here.mean)
    assert abs(here.mean) == pytest.approx(tilt, abs=4 * here.sd)
    both = spanning({"toward_y": here}, [{"toward_y": there}])["toward_y"]
    assert isinstance(both, finding.Quantity)
    low, high = both.interval
    assert -low == pytest.approx(high) and high > abs(here.mean)


def test_of_several_mirrors_all_are_told_that_do_as_well(tmp_path, monkeypatch):
    values = {"toward_x": 0.2, "toward_y": 0.3}
    belief, placed = believed(tmp_path, "gravity_tilt", "world", values, lambda model, data: None)
    here = np.array([*belief.fit.point.z[:-2], 2.0, 3.0])
    steep = np.array([0.4, 0.0])  # nats by which a turned sign does worse

    def log_density(self, z):
        return -np.abs(np.abs(z[:, -2:]) - here[-2:]).sum(1) - (z[:, -2:] < 0) @ steep

    monkeypatch.setattr(Density, "log_density", log_density)
    z = here + 0.01 * np.random.default_rng(0).standard_normal((len(belief.z), len(here)))
    linear = replace(belief.fit.linear, point=replace(belief.fit.point, z=here))
    symmetric = replace(belief, fit=replace(belief.fit, linear=linear), z=z)
    signs = [np.sign(draws[:, -2:].mean(0)).tolist() for draws in mirrored(symmetric, placed)]
    assert signs == [[1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]
    steep[0] = 1.5
    assert [np.sign(d[:, -2:].mean(0)).tolist() for d in mirrored(symmetric, placed)] == [[1.0, -1.0]]
    turned = np.where(np.arange(len(here)) == len(here) - 1, -1, 1)
    told, other = (parameters(belief.fit, placed, draws)["toward_y"] for draws in (z, turned * z))
    assert isinstance(told, finding.Quantity) and isinstance(other, finding.Quantity)
    every = spanning({"toward_y": told}, [{}, {"toward_y": other}, {"toward_y": told}])["toward_y"]
    assert isinstance(every, finding.Quantity)
    assert every.interval == (other.interval[0], told.interval[1])
