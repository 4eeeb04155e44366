"""What a replay draws: shapes and poses together put every geom where MuJoCo has it."""

import mujoco
import numpy as np
import pytest
from conftest import ARM, FREE

from det2stoc_bayes.engines.rotations import product
from det2stoc_bayes.engines.shapes import MOST_FACES, moving_bodies, poses, shapes

HAND = """
<body name="mount" pos="1 0 0.5" euler="0 30 0"><body name="wheel" pos="0.1 0 0"><joint axis="1 1 0"/>
  <geom type="cylinder" size="0.1 0.02" pos="0.02 0.1 0" euler="40 0 0" rgba="1 0 0 0.4"/>
  <geom type="sphere" size="0.3" group="3"/>
  <body name="tip" pos="0 0 0.2" euler="0 0 20"><geom type="ellipsoid" size="0.1 0.02 0.03" euler="0 50 0"/></body>
</body></body><geom type="plane" size="0 0 1" euler="10 0 0"/>"""


def _turned(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    inverse = quaternion * np.array([1, -1, -1, -1])
    return product(product(quaternion, np.append(0.0, vector)), inverse)[1:]


def test_shapes_and_poses_are_where_mujoco_has_the_geoms(compiled) -> None:
    model = compiled(ARM + FREE + HAND)
    qpos = np.array(model.qpos0) + np.random.default_rng(0).normal(size=(5, model.nq))
    qpos[3, 1] = np.nan
    found, places = shapes(model), poses(model, qpos)
    seen = [g for g in range(model.ngeom) if model.geom_group[g] < 3]
    assert len(found) == len(seen) and np.isnan(places[3]).all()
    data = mujoco.MjData(model)
    for k in (0, 1, 2, 4):
        data.qpos[:] = qpos[k]
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        for shape, g in zip(found, seen, strict=True):
            body = np.array([0, 0, 0, 1.0, 0, 0, 0]) if shape.body < 0 else places[k, shape.body]
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, product(body[3:], shape.quaternion))
            np.testing.assert_allclose(body[:3] + _turned(body[3:], shape.position), data.geom_xpos[g], atol=1e-9)
            np.testing.assert_allclose(turn, data.geom_xmat[g], atol=1e-9)
    assert [model.body(b).name for b in moving_bodies(model)] == ["upper", "lower", "stone", "wheel"]
    assert found[-3].kind == "plane" or found[0].kind == "plane"
    assert {s.kind for s in found} == {"capsule", "box", "cylinder", "ellipsoid", "plane"}


def test_a_body_without_geoms_is_the_box_of_its_inertia(compiled) -> None:
    inertial = '<inertial pos="0.1 0 0" mass="2" diaginertia="0.05 0.04 0.03"/>'
    model = compiled(f'<body name="ghost"><joint/>{inertial}</body>')
    (box,) = shapes(model)
    x, y, z = box.size**2
    np.testing.assert_allclose(2 / 3 * np.array([y + z, x + z, x + y]), [0.05, 0.04, 0.03], rtol=1e-9)
    np.testing.assert_allclose(box.position, [0.1, 0, 0], atol=1e-12)


@pytest.mark.parametrize("rings, kept", [(12, True), (60, False)])
def test_a_fine_mesh_is_replaced_by_its_hull(rings, kept) -> None:
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, rings, endpoint=False), np.linspace(-0.2, 0.2, rings))
    bulge = 0.1 + 0.02 * np.cos(20 * height)  # hollow places, which the hull bridges
    points = np.stack([bulge * np.cos(angle), bulge * np.sin(angle), height], -1).reshape(-1, 3)
    corner = (np.arange(rings - 1)[:, None] * rings + np.arange(rings)).ravel()
    beside = (np.arange(rings - 1)[:, None] * rings + (np.arange(rings) + 1) % rings).ravel()
    faces = np.concatenate(
        [np.stack([corner, beside, corner + rings], 1), np.stack([beside, beside + rings, corner + rings], 1)]
    )
    text = " ".join(map(str, points.ravel())), " ".join(map(str, faces.ravel()))
    mesh = f'<asset><mesh name="vase" inertia="shell" vertex="{text[0]}" face="{text[1]}"/></asset>'
    body = '<body><joint/><geom type="mesh" mesh="vase" density="100"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{mesh}<worldbody>{body}</worldbody></mujoco>")
    (shape,) = shapes(model)
    whole = model.mesh_vert
    assert (len(shape.faces) == len(model.mesh_face)) is kept and 0 < len(shape.faces) <= MOST_FACES
    np.testing.assert_allclose([shape.vertices.min(0), shape.vertices.max(0)], [whole.min(0), whole.max(0)], atol=1e-6)
    if not kept:
        a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
        outward = (np.cross(b - a, c - a) * (a - shape.vertices.mean(0))).sum(1)
        assert (outward > 0).all()


def test_a_height_field_is_its_surface() -> None:
    field = '<asset><hfield name="hill" nrow="2" ncol="3" size="3 1 0.5 0.1" elevation="0 0 0 0 1 0"/></asset>'
    xml = f'<mujoco>{field}<worldbody><geom type="hfield" hfield="hill"/></worldbody></mujoco>'
    (shape,) = shapes(mujoco.MjModel.from_xml_string(xml))
    assert shape.vertices.shape == (6, 3) and shape.faces.shape == (4, 3)
    top = shape.vertices[shape.vertices[:, 2].argmax()]
    np.testing.assert_allclose(top[[0, 2]], [0, 0.5], atol=1e-6)
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
