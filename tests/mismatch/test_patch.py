"""patched.xml: what it sets, what it leaves, what it needs beside it."""

import shutil
import struct
import zlib

import mujoco
import pytest
from conftest import ARM, FREE, MOTORS, make_study, model_xml

from det2stoc_bayes.errors import ModelError
from det2stoc_bayes.mismatch.patch import assets, make_patch
from det2stoc_bayes.mismatch.patch_fields import differences

PSI = """
[psi.mass]
target = "body/lower/mass"
prior = { Normal = { loc = 0.6, scale = 0.1 } }
[psi.loss]
target = "joint/*/frictionloss"
prior = { HalfNormal = { scale = 0.1 } }
varies = "trajectory"
[psi.tilt]
target = "opt/gravity"
index = [0, 1]
prior = { Normal = { loc = 0.0, scale = 0.1 } }
[psi.gear]
target = "actuator/turn/gear"
index = [0]
prior = { Normal = { loc = 2.0, scale = 0.1 } }
[known.one]
"joint/elbow/damping" = 0.9
"""
GIVEN = {"mass": 0.61234567890123456, "loss": 0.123456789012345, "tilt": 1 / 3, "gear": 2.2}


def test_psi_round_trip(tmp_path):
    study = make_study(tmp_path / "study", model_xml(ARM, MOTORS), PSI)
    believed = mujoco.MjModel.from_xml_path(str(study.model_path))
    patch = make_patch(study, GIVEN)
    model = mujoco.MjModel.from_xml_string(patch.model)
    assert mujoco.__version__ in patch.model
    assert patch.module is None
    wanted = mujoco.MjModel.from_xml_path(str(study.model_path))
    wanted.body("lower").mass, wanted.dof_frictionloss[:] = GIVEN["mass"], GIVEN["loss"]
    wanted.opt.gravity[:2], wanted.actuator_gear[0, 0] = GIVEN["tilt"], GIVEN["gear"]
    assert not differences(wanted, model)  # so inertia did not follow mass, and damping is not the known recording's
    assert set(differences(believed, model)) == {
        "body_mass",
        "dof_frictionloss",
        "opt.gravity",
        "actuator_gear",
    }
    assert model.names == believed.names
    assert model.dof_invweight0[1] != believed.dof_invweight0[1]  # constants derived from mass follow


def test_missing_and_unknown_psi(tmp_path):
    study = make_study(tmp_path / "study", model_xml(ARM), PSI.split("[psi.gear]")[0])
    with pytest.raises(ModelError, match="psi.mass: no value"):
        make_patch(study, {"loss": 0.1, "tilt": 0.0})
    with pytest.raises(ModelError, match="psi.gera: no such parameter.*mass, loss, tilt"):
        make_patch(study, {"mass": 0.1, "loss": 0.1, "tilt": 0.0, "gera": 1.0})


SIZES = """
[psi.size]
target = "geom/box/size"
index = [0]
prior = { HalfNormal = { scale = 0.1 } }
[psi.centre]
target = "body/stone/ipos"
index = [1]
prior = { Normal = { loc = 0.0, scale = 0.1 } }
"""


def test_a_field_is_set_alone(tmp_path):
    # A body's inertia is worked out from its geoms, here with degrees, frames and defaults on the way.
    bodies = FREE.replace("<geom ", '<frame pos="0.1 0 0" euler="0 0 30"><geom name="box" ').replace(
        "/></body>", "/></frame></body>"
    )
    study = make_study(
        tmp_path / "study",
        f'<mujoco><compiler angle="degree"/><worldbody>{bodies}</worldbody></mujoco>',
        SIZES,
    )
    model = mujoco.MjModel.from_xml_string(make_patch(study, {"size": 0.2, "centre": 0.03}).model)
    believed = mujoco.MjModel.from_xml_path(str(study.model_path))
    assert set(differences(believed, model)) == {"geom_size", "body_ipos"}
    assert (model.geom_size[0, 0], model.body_ipos[1, 1]) == (0.2, 0.03)


LIMIT = """
[psi.limit]
target = "joint/elbow/actfrcrange"
index = [1]
prior = { HalfNormal = { scale = 1.0 } }
"""


def test_what_mjcf_cannot_say(tmp_path):
    study = make_study(tmp_path / "study", model_xml(ARM, MOTORS), LIMIT)
    patch = make_patch(study, {"limit": 3.0})
    model, effects = mujoco.MjModel.from_xml_string(patch.model), {}
    exec(patch.module, effects)
    for _ in range(2):
        effects["reset"](model, mujoco.MjData(model))
        assert model.jnt_actfrcrange[1].tolist() == [0.0, 3.0]
    assert "actfrcrange" in patch.model.split("-->")[0]
    assert (make_patch(study, {"limit": 3.0}).model, make_patch(study, {"limit": 3.0}).module) == (
        patch.model,
        patch.module,
    )


def png():
    """A picture of 2 x 2."""
    rows = b"".join(b"\0" + b"\x80\x40\x20" * 2 for _ in range(2))
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", 2, 2, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    ]
    chunks = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


ASSETS = """<mujoco><compiler meshdir="meshes" texturedir="tex"/><include file="more.xml"/>
<asset><mesh file="tet.obj"/><material name="m" texture="t"/></asset>
<worldbody><body name="b"><joint name="j" axis="0 1 0"/><geom type="mesh" mesh="tet" material="m"/></body>
</worldbody></mujoco>"""


def test_assets_lie_beside(tmp_path):
    study = make_study(tmp_path / "plain", model_xml(ARM))
    folder = study.folder
    (folder / "meshes").mkdir(), (folder / "tex").mkdir()
    corners = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (folder / "meshes/tet.obj").write_text(corners)
    (folder / "tex/a.png").write_bytes(png())
    (folder / "more.xml").write_text('<mujoco><asset><texture name="t" type="2d" file="a.png"/></asset></mujoco>')
    (folder / "model.xml").write_text(ASSETS)
    assert [p.relative_to(folder).as_posix() for p in assets(study)] == [
        "meshes/tet.obj",
        "tex/a.png",
    ]
    patch, out = make_patch(study, {}), tmp_path / "out"
    for name, source in patch.assets.items():
        (out / name).parent.mkdir(parents=True)
        shutil.copy(source, out / name)
    (out / "patched.xml").write_text(patch.model)
    model = mujoco.MjModel.from_xml_path(str(out / "patched.xml"))
    assert not differences(mujoco.MjModel.from_xml_path(str(study.model_path)), model, derived=True)
