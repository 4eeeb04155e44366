"""Addresses of columns."""

import mujoco
import numpy as np
import pytest
from conftest import model_xml

from det2stoc_bayes.engines.layout import column_address
from det2stoc_bayes.engines.model_names import model_names
from det2stoc_bayes.engines.state_columns import state_columns

SLASHES = """
<body><joint name="robot/arm/elbow"/><geom size="0.1"/><site name="robot/tip"/></body>
<body><freejoint name="thing/float"/><geom size="0.1"/></body>
<body><joint name="thing/x" type="ball"/><geom size="0.1"/></body>"""
SENSED = '<sensor><gyro name="robot/gyro" site="robot/tip"/><jointpos name="robot/q" joint="robot/arm/elbow"/></sensor>'


def test_every_column_of_names_with_slashes_has_its_own_address():
    model = mujoco.MjModel.from_xml_string(model_xml(SLASHES, SENSED))
    columns = model_names(model).columns
    found = [column_address(model, c) for c in columns]
    assert {(a.source, a.index) for a in found if a.source == "qpos"} == {("qpos", i) for i in range(model.nq)}
    assert {(a.source, a.index) for a in found if a.source == "qvel"} == {("qvel", i) for i in range(model.nv)}
    assert {(a.source, a.index) for a in found if a.source == "sensordata"} == {("sensordata", i) for i in range(4)}
    at = dict(zip(columns, found, strict=True))
    assert at["qvel/thing/x/wz"].index == 9 and at["qpos/thing/float/qw"].index == 4
    assert at["sensor/robot/gyro/2"].index == 2
    with pytest.raises(KeyError, match="robot/knee"):
        column_address(model, "qpos/robot/knee")


FLOATING = """
<body name="stone" pos="0 0 2"><freejoint name="float"/><geom type="box" size=".1 .2 .3" mass="1"/>
  <site name="centre"/><site name="corner" pos=".1 .2 .3"/></body>
<body name="arm"><joint name="hinge" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/><site name="tip"/></body>"""
FRAMES = """<sensor>
  <framepos name="place" objtype="xbody" objname="stone"/><framequat name="turn" objtype="site" objname="centre"/>
  <gyro name="gyro" site="centre"/><framelinvel name="speed" objtype="body" objname="stone"/>
  <framepos name="corner" objtype="site" objname="corner"/><gyro name="arm_gyro" site="tip"/>
  <framepos name="seen_from" objtype="site" objname="centre" reftype="body" refname="arm"/>
  <jointvel name="rate" joint="hinge"/><jointpos name="clipped" joint="hinge" cutoff="1"/>
</sensor>"""


def test_sensors_that_repeat_a_state_do_so_in_a_simulation():
    model = mujoco.MjModel.from_xml_string(model_xml(FLOATING, FRAMES))
    columns = tuple(c for c in model_names(model).columns if c.startswith("sensor/"))
    places = state_columns(model, columns)
    assert {columns[j].split("/")[1] for j in places.values()} == {"place", "turn", "gyro", "speed", "rate"}
    data = mujoco.MjData(model)
    data.qpos[:] = [0.1, -0.2, 2.0, 0.5, 0.5, -0.5, 0.5, 0.3]
    data.qvel[:] = np.arange(1.0, 8.0)
    mujoco.mj_forward(model, data)
    for (source, index), j in places.items():
        assert data.sensordata[column_address(model, columns[j]).index] == pytest.approx(getattr(data, source)[index])


def test_a_joints_own_column_goes_before_a_sensor():
    model = mujoco.MjModel.from_xml_string(model_xml(FLOATING, FRAMES))
    assert state_columns(model, ("sensor/rate", "qvel/hinge")) == {("qvel", 6): 1}
