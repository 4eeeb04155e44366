"""Typical magnitudes, from which priors of effects have their scales."""

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import noise_table, pose, recordings

from det2stoc_bayes.engines.elements import body_elements
from det2stoc_bayes.engines.magnitudes import Magnitudes

SHELL = """<body name="arm"><joint name="pivot" axis="0 1 0"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5" mass="0.1"/>
  <body name="load" pos="0 0 -0.5"><geom type="sphere" size="0.05" mass="0.7"/></body></body>"""


def test_what_is_welded_together_weighs_together(tmp_path):
    made = recordings(model_xml(SHELL), [([0.5], [0.0])], 10 * np.arange(30), (1e-3, 1e-2))
    problem = pose(make_study(tmp_path / "study", model_xml(SHELL), noise_table(1e-3, 1e-2), made))
    typical = Magnitudes(problem)
    arm, load = (typical.of(e) for e in body_elements(problem.simulator.model))
    assert arm.inertia == load.inertia == pytest.approx(0.8)
    assert arm.force >= 0.8 * 9.81 * 0.999 and arm.span != load.span
